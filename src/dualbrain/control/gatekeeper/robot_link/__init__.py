"""Link between the gatekeeper and the robot process: packets over a socket pair."""
