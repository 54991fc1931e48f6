"""Drivers of real arms behind the robot interface, fakes of their vendor libraries, and a conformance test."""
