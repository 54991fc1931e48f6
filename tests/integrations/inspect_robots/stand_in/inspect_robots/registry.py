"""Components by kind and name; the stand-in reads no entry points."""

_FACTORIES = {"embodiment": {}}


def register(kind, name):
    """Register a factory."""

    def decorator(factory):
        _FACTORIES[kind][name] = factory
        return factory

    return decorator


def registered(kind):
    """All factories of a kind."""
    return dict(_FACTORIES[kind])


def resolve(kind, name, /, **kwargs):
    """Make a component."""
    return registered(kind)[name](**kwargs)
