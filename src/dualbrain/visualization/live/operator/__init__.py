"""Parts of the live page for the operator: the state of the robot in words, and the field for instructions."""
