"""Experiments on the interfaces: untrusted bytes, contracts, observations and documents."""
