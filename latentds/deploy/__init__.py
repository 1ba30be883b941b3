"""Fitted systems outside torch."""
