"""The common filter problem, its scenes, an adversarial nominal control and the exact optimum."""
