"""Other people's recordings: a file as a table, and its columns as a motion."""

from .interpretation import Motion, interpret
from .readers import READERS, Table, as_table, read_table

__all__ = ["READERS", "Motion", "Table", "as_table", "interpret", "read_table"]
