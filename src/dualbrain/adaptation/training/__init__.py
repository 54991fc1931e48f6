"""Training of an adapter. All modules except `process_group` need torch (`pip install dualbrain[adapt]`)."""

import logging

logging.getLogger("bitsandbytes").setLevel(logging.ERROR)  # peft imports it; it warns of a kernel that we do not use
