"""The records of the phones on the decoder's paths, and the search for shared ones."""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Floats

NO_RECORD = -1
IMPOSSIBLE = np.float32(-1e30)  # score of a state that no path reaches


class Tokens(NamedTuple):
    """Preallocated arrays of the tokens; only the first ones are in use."""

    context: NDArray[np.int32]  # (tokens,)
    top: Floats  # (tokens,)
    score: Floats  # (tokens, states)
    link: NDArray[np.int32]  # (tokens, states)


@numba.njit(cache=True)
def count_record_paths(
    num_tokens: int, tokens: Tokens, records: NDArray[np.int32], paths: NDArray[np.int32]
) -> int:
    """Count the paths through each record, (records,); return the last one that all paths share."""
    num_paths, shared = 0, NO_RECORD
    for token in range(num_tokens):
        for state in range(tokens.score.shape[1]):
            if tokens.score[token, state] > IMPOSSIBLE:
                num_paths += 1
                if tokens.link[token, state] != NO_RECORD:
                    paths[tokens.link[token, state]] += 1
    for record in range(len(paths) - 1, -1, -1):  # a record comes after the one before it
        if paths[record] and records[record, 2] != NO_RECORD:
            paths[records[record, 2]] += paths[record]
        if paths[record] == num_paths:
            shared = max(shared, record)
    return shared


@numba.njit(cache=True)
def compact_records(
    shared: int,
    paths: NDArray[np.int32],
    num_tokens: int,
    tokens: Tokens,
    records: NDArray[np.int32],
) -> tuple[int, int]:
    """Drop the records without paths, and those before the shared one.

    Returns the number of records, and the new index of the shared one.
    """
    new = np.full(len(paths) + 1, np.int32(NO_RECORD))  # the last one is for NO_RECORD
    num_kept = 0
    for record in range(max(shared, 0), len(paths)):
        if paths[record]:
            new[record] = num_kept
            records[num_kept, 0], records[num_kept, 1] = records[record, 0], records[record, 1]
            records[num_kept, 2] = new[records[record, 2]]
            num_kept += 1
    for token in range(num_tokens):
        for state in range(tokens.score.shape[1]):
            if tokens.score[token, state] > IMPOSSIBLE:
                tokens.link[token, state] = new[tokens.link[token, state]]
    return num_kept, new[shared]
