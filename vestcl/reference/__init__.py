"""The pure-torch reference implementation of each operator: same file, same name, same signature.

Slow, differentiable, on any device.
"""

from vestcl.reference.displace import displace
from vestcl.reference.rigid_flow import rigid_flow
from vestcl.reference.splat import splat
from vestcl.reference.stretch import stretch
from vestcl.reference.unproject import unproject

__all__ = ["displace", "rigid_flow", "splat", "stretch", "unproject"]
