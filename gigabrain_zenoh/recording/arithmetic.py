"""Has numpy compute the same on every x86-64 processor with AVX2. To be imported before numpy.

Left alone, OpenBLAS and numpy choose among ways that round differently by what the processor has
(AVX-512 or not), and a recorded drive is not repeated to the last bit. Processes started from here
do the same, unless their environment says otherwise.
"""

import os
import platform
from importlib import metadata

X86_64 = ("x86_64", "AMD64")
WIDE = {  # names of what is left out, by the numpy that has them
    True: "X86_V4 AVX512_ICL AVX512_SPR",  # from 2.4 on
    False: "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
}


def _choose() -> None:
    if platform.machine() not in X86_64:
        return
    major, minor, *_ = metadata.version("numpy").split(".")
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
    os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", WIDE[(int(major), int(minor)) >= (2, 4)])


_choose()
