"""What users are told."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from arm5dof.errors import UserError


def said(call: Callable[[], object]) -> str:
    """The one line of the `UserError` that a call raises."""
    with pytest.raises(UserError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)
