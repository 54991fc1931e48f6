"""An independent simulator of the Franka Control Interface: its environment, its process, and a session with it."""
