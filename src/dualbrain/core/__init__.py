"""Foundation of the package: text, units, geometry, storage and model weights. Imports only `dualbrain.errors`."""
