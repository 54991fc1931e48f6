"""The adapter `guard_robosuite` inside robosuite's own environment: Lift, Stack and PickPlaceCan."""
