"""Other people's recordings: a file as a table, and its columns as a motion."""

from .interpretation import Asked, Motion, interpret, interpret_all
from .readers import READERS, Table, as_table, read_table

__all__ = ["READERS", "Asked", "Motion", "Table", "as_table", "interpret", "interpret_all", "read_table"]
