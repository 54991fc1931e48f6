"""The control thread under a PREEMPT_RT kernel in a virtual machine."""
