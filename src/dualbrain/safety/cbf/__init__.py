"""The velocity-level CBF-QP filter; `kernel` is the only module that calls the compiled C kernel."""
