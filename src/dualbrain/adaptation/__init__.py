"""How it learns at night (paper 6): clean episodes, objective, fitting an adapter, the registry that promotes it."""
