"""Makes numpy round the same on every x86-64 processor with AVX2. Import it before numpy.

By default OpenBLAS and numpy choose code by the processor's instructions (AVX-512 or not), and
OpenBLAS divides its work by the number of cores. The results are rounded differently, so a replay
would not equal the recorded drive to the last bit. Child processes inherit these settings.
"""

import os
import platform
from importlib import metadata

from gigabrain_zenoh.host.this_process import multiply_in_one_thread

X86_64 = ("x86_64", "AMD64")
AVX512_FEATURES = {  # numpy's names of instructions to disable; True: numpy 2.4 or newer
    True: "X86_V4 AVX512_ICL AVX512_SPR",
    False: "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
}


def _disable_avx512() -> None:
    if platform.machine() not in X86_64:
        return
    major, minor, *_ = metadata.version("numpy").split(".")
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
    os.environ.setdefault(
        "NPY_DISABLE_CPU_FEATURES", AVX512_FEATURES[(int(major), int(minor)) >= (2, 4)]
    )


_disable_avx512()
multiply_in_one_thread()
