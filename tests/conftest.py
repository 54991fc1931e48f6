"""A busy machine is no failure: properties are checked however long one example takes."""

from hypothesis import settings

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
