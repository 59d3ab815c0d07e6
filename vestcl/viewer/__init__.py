"""The viewer: a page on the loopback address that shows a clip's future from any camera (`vestcl view`)."""
