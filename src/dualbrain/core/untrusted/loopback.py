"""Addresses that only processes of this machine reach, and addresses that mean all of its interfaces."""

from __future__ import annotations

from ipaddress import ip_address


def is_loopback(host: str) -> bool:
    """Whether `host` is an address of this machine only."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_wildcard(host: str) -> bool:
    """Whether `host` means every interface of this machine and is no address of any, such as 0.0.0.0."""
    try:
        return ip_address(host).is_unspecified
    except ValueError:
        return not host
