"""Actuator parameters from logs."""
