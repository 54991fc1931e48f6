"""The spinal room: barriers, the safety filter, the intervention metric; `native` is the only file that knows the C kernel."""
