"""MuJoCo simulation: plant, scenes, tasks, perception model and the independent safety monitor."""
