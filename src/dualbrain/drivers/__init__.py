"""Drivers: real arms behind the `Robot` protocol, fakes of their interfaces, and the laws that every driver keeps."""
