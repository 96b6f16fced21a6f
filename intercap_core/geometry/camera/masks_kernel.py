"""COCO's run-length strings, compiled."""

from __future__ import annotations

import numba
import numpy as np

FINE, STRANGE, CUT, LONG, NEGATIVE = range(5)  # what :func:`parse` says of a string
_ZERO = 48  # first character of the alphabet
_LONGEST_NUMBER = 7  # characters of 5 bits: enough for a run of 2^34 pixels


@numba.njit(cache=True, nogil=True)
def parse(characters):
    """Ends (n,) int64 of the runs of a string's ``characters`` (m,) uint8, and what is wrong with
    it, ``FINE`` = nothing.

    Each number is written in groups of 5 bits, lowest first, bit 5 = more follow, bit 4 of the
    last = sign; from the fourth on it is the difference to the number two before.
    """
    ends = np.empty(len(characters), np.int64)
    first = ends[:0]
    for character in characters:
        if character < _ZERO or character > _ZERO + 63:
            return first, STRANGE
    if (characters[-1] - _ZERO) & 0x20:
        return first, CUT
    count, digits, value = 0, 0, np.int64(0)
    one, before, end = np.int64(0), np.int64(0), np.int64(0)  # the last number, the one before it
    too_long = negative = False
    for character in characters:
        bits = np.int64(character) - _ZERO
        if digits >= _LONGEST_NUMBER:
            too_long = True
            break
        value |= (bits & 0x1F) << (5 * digits)
        digits += 1
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= np.int64(1) << (5 * digits)
        if count > 2:
            value += before
        if value < 0:
            negative = True
        end += value
        ends[count] = end
        before, one = one, value
        count, digits, value = count + 1, 0, np.int64(0)
    if too_long:
        return first, LONG
    return ends[:count].copy(), NEGATIVE if negative else FINE


@numba.njit(cache=True, nogil=True)
def box(ends, height):
    """x, y, width, height of what runs with these ``ends`` (n,) set; all 0 where there is none."""
    left, right, top, bottom = -1, 0, height, -1
    for run in range(1, len(ends), 2):
        start, stop = ends[run - 1], ends[run]
        if stop <= start:
            continue
        last = stop - 1
        if left < 0:
            left = start // height
        right = last // height
        if start // height != right:  # over a column's end
            top, bottom = 0, height - 1
        else:
            top, bottom = min(top, start % height), max(bottom, last % height)
    if left < 0:
        return 0, 0, 0, 0
    return left, top, right - left + 1, bottom - top + 1
