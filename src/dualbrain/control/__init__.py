"""The control loop: executes accepted contracts through skills, filter and supervisor; no language model in it."""
