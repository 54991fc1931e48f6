"""Compiled builds of the C kernel (float32 and float64, normal and large), with their type stubs."""
