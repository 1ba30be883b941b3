"""The methods that learn by matching."""
