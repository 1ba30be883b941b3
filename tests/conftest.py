"""What several test files share."""

from __future__ import annotations

import pytest
import torch

torch.set_num_threads(1)  # pytest-xdist gives every core a worker; more threads than that only wait for each other


@pytest.fixture
def draw() -> torch.Generator:
    return torch.Generator().manual_seed(7)
