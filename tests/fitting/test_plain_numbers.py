"""Statistics as counts again."""

from __future__ import annotations

import numpy as np

from dase.fitting.plain_numbers import family_counts
from dase.probes.statistics import LAYOUT, SIZE


def test_no_event_is_none_whatever_the_logarithm_rounds_to():
    values = np.full(SIZE, np.nan)
    part = LAYOUT["rate"]
    counts = np.arange(part.stop - part.start) % 3
    # the logarithm of a vector and that of a number need not round alike
    for nudge in (0.0, -np.inf, np.inf):
        values[part] = np.nextafter(np.log(counts + 3.0), nudge) if nudge else np.log(counts + 3.0)
        found = family_counts(values, "rate")
        assert (found[counts == 0] == 0).all()
        np.testing.assert_allclose(found, counts, rtol=1e-14)
