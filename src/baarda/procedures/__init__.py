"""Loops and joins over adjusting and testing."""
