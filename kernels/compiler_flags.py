"""The flags with which all kernels are compiled for a CPU.

Clang reads Warp's headers anew for each set of flags, which takes 1.5 to 3 s: as long as several kernels. So
there is one set.
"""

import warp as wp

CPU_FLAGS = f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512"
"""Those of Warp, and vectors of 512 bits, which LLVM shuns by itself on Intel: kernels that work on several
pixels at once would need twice the instructions. Bits are the same."""
