"""The paper, reproduced: its tables, figures and claims, set beside ours. See ``__main__`` for the command.

One file per section of the report: what it measures, writes and judges. ``study`` and ``tuning`` hold what they share,
``document`` what they write into.
"""
