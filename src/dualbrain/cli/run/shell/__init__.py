"""dualbrain shell: instructions one after another, with the planner, the memory and the scene kept open."""
