"""What several test files share."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture
def draw() -> torch.Generator:
    return torch.Generator().manual_seed(7)
