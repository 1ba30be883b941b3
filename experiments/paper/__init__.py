"""The paper, reproduced: its tables, figures and claims, set beside ours. See ``__main__`` for the command.

``measurements`` computes (by ``tuning``, ``held_out``, ``latent_space`` and ``variants``), ``sections`` and ``figures``
tell, ``verdicts`` judges.
"""
