"""Every method under one protocol: ``python -m experiments.field``."""
