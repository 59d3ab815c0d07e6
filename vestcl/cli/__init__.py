"""The command line: `main`, a file per command, and the options that commands share."""
