"""Import of robots from a package of models, compared with an independent library."""
