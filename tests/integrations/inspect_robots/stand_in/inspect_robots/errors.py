"""Errors; SafetyAbort always halts an evaluation."""


class InspectRobotsError(Exception):
    pass


class ConfigError(InspectRobotsError):
    pass


class SafetyAbort(InspectRobotsError):  # noqa: N818
    pass
