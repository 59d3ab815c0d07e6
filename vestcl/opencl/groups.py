"""Work-groups: how many work-items run together."""

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from vestcl.opencl.session import Session

#: Work-items in a work-group of a GPU: two warps of NVIDIA, one wavefront of AMD.
GPU_GROUP: Final = 64


def grouped(session: "Session", count: int, at_once: int = 1) -> tuple[int, int]:
    """Global and local size of a dimension of ``count`` independent work-items.

    A CPU runs each as a group of its own. The mapping "pixel" has whole groups of GPU_GROUP: the last one may reach
    beyond ``count``, so kernels get that number and compare their index with it.

    Args:
        session: whose mapping counts.
        count: work-items along this dimension.
        at_once: work-items of a group along the other dimensions.
    """
    if session.mapping == "tile":
        return count, 1
    group = max(1, GPU_GROUP // at_once)
    return -(-count // group) * group, group
