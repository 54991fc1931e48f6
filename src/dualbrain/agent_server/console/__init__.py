"""The console: a static page that shows a robot, its runs and its memory, checks contracts, and stops the robot."""
