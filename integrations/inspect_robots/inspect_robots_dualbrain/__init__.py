"""Plugin of inspect-robots: the embodiment `dualbrain_guarded` guards any other one, and contributes an approver.

inspect-robots finds the embodiment by its entry point of the group `inspect_robots.embodiments`.
"""

from inspect_robots_dualbrain.approver import DualbrainApprover, Review
from inspect_robots_dualbrain.guarded_embodiment import GuardedEmbodiment, dualbrain_guarded

__all__ = ["DualbrainApprover", "GuardedEmbodiment", "Review", "dualbrain_guarded"]
