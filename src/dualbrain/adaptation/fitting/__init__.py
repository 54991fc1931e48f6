"""Fitting an adapter; all in here but `team` needs torch (`pip install dualbrain[adapt]`), nothing else does."""

import logging

logging.getLogger("bitsandbytes").setLevel(logging.ERROR)  # peft imports it; it warns of a kernel that we do not use
