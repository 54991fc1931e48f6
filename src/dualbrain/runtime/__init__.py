"""The episode loop: instruction, retrieval, proposal, gate, execution, outcome, memory. Start at `episode`."""
