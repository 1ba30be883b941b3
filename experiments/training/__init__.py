"""Stable systems inside other torch models, trained by plain torch. See ``__main__`` for the command.

``via_point``, ``density`` and ``context`` are an example each, ``loop`` the loop that they share.
"""
