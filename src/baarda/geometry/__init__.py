"""Formulas of imaging geometry with their partial derivatives: pure functions on arrays."""
