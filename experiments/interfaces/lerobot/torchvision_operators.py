"""Declares the compiled operators that torchvision names at import and that its wheel cannot load beside a CPU torch.

`virtual_environment` copies this file into the environment and lets torchvision import it first. An operator without an
implementation raises when it is called; reading a dataset and training a policy on joint values call none.
"""

import torch

BOXES = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
OPERATORS = torch.library.Library("torchvision", "FRAGMENT")
for name in ("nms", "qnms"):
    OPERATORS.define(name + BOXES)
