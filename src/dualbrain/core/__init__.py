"""Ground floor of the package: text, units, geometry, storage and model weights. Imports nothing but errors."""
