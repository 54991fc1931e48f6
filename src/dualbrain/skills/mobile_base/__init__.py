"""Skills of a mobile base and the controller that they share."""
