"""Skills of an arm and the controller that they share."""
