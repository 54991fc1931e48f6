"""The spinal room: barriers, the safety filter, the intervention metric; `native` alone knows the C kernel."""
