"""How the C library's heap keeps memory that is free again (glibc; elsewhere nothing is done)."""

import contextlib
import ctypes

M_MMAP_THRESHOLD = -3  # mallopt(3)
LARGE_BYTES = 4 << 20  # the costs of a map of 50 x 50 m, and less, stay in the heap


def map_large_blocks() -> None:
    """Have blocks of LARGE_BYTES and more go back to the system as soon as they are free.

    By itself glibc raises that limit to 32 MiB as blocks are freed, and then keeps those of each
    thread: 119 MB after planning in a few maps of 140 x 140 m, and 1 MB with this.
    """
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)


def trim() -> None:
    """Return what is free to the system. It may take some milliseconds."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
