"""The compiled safety kernel with its type stubs, one extension module per build.

`_kernel` (float32) and `_kernel64` (float64) have the default size; `_kernel_wide` and `_kernel64_wide` have room for
more joints, links and spheres. CMake builds all four from `kernel/`; their interface is that of `_kernel.pyi`.
"""
