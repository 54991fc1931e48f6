"""Integrations of the safety filter: site files, derating, shadow mode, fused scenes, and Gymnasium environments."""
