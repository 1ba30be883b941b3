"""Every method of the field under the same protocols: ``python -m experiments.field``."""
