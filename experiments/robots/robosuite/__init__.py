"""The filter in the loop of a task suite that others wrote: robosuite, in an environment and a process of its own."""
