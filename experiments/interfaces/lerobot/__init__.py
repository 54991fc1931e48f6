"""LeRobot 0.6.1 in a virtual environment of its own, which reads exported datasets and trains from them."""
