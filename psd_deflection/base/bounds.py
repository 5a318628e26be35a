# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What others can make grow has a bound here: the bytes that wait for something, the words that are remembered."""

import threading
from collections.abc import Iterator, Mapping, MutableMapping
from typing import TypeVar

K = TypeVar('K')
V = TypeVar('V')

MOST_WORDS = 1000
"""Names of others that one map remembers: more joints, topics or reasons than any rig has."""

OTHERS = 'others'
"""The word under which a tally counts what has no room of its own."""

MESSAGE_BYTES = 300
"""What Python needs for a message that waits, beside its content: a tuple, its texts and numbers."""


class ByteBudget:
    """At most ``most`` bytes may be held together; for any thread.

    ``held``: those that are held now, taken ``holders`` times.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.held = self.holders = 0
        self._lock = threading.Lock()

    def take(self, size: int) -> bool:
        """Hold ``size`` bytes more; False, and nothing is held, if that would be too many."""
        with self._lock:
            if self.held + size > self.most:
                return False
            self.held += size
            self.holders += 1
            return True

    def give_back(self, size: int, holders: int = 1) -> None:
        """``size`` bytes, which were taken ``holders`` times, are held no more."""
        with self._lock:
            self.held -= size
            self.holders -= holders


class RateLimit:
    """At most ``most`` events within a second. It owns no clock; one thread at a time."""

    def __init__(self, most: int) -> None:
        self.most = most
        self._since, self._count = 0.0, 0

    def allows(self, now_s: float) -> bool:
        """Whether one more may be, ``now_s``: monotonic, s."""
        if now_s - self._since >= 1.0:
            self._since, self._count = now_s, 0
        self._count += 1
        return self._count <= self.most


class BoundedMap(MutableMapping[K, V]):
    """A map of at most ``most`` keys. A further key takes the place of the one that was set longest ago.

    Whoever floods it with new keys drives out what nobody sets any more; what is set again and again stays.
    """

    def __init__(self, most: int = MOST_WORDS) -> None:
        self.most = most
        self._items: dict[K, V] = {}

    def __getitem__(self, key: K) -> V:
        return self._items[key]

    def __setitem__(self, key: K, value: V) -> None:
        # In a copy: whoever reads from another thread never finds the key gone.
        items = self._items.copy()
        items.pop(key, None)
        if len(items) >= self.most:
            del items[next(iter(items))]
        items[key] = value
        self._items = items

    def __delitem__(self, key: K) -> None:
        del self._items[key]

    def __iter__(self) -> Iterator[K]:
        # A copy: another thread may read while its owner writes.
        return iter(tuple(self._items))

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return f'{type(self).__name__}({self._items!r})'


class Tally(Mapping[str, int]):
    """Counts by words, of at most ``most`` words; further words are counted together as :data:`OTHERS`.

    One thread counts; any thread may read. The count of a word that it does not know is 0.
    """

    def __init__(self, most: int = MOST_WORDS) -> None:
        self.most = most
        self._counts: dict[str, int] = {}

    def add(self, word: str, count: int = 1) -> None:
        """Count ``word``."""
        if word not in self._counts and len(self._counts) >= self.most - 1:
            word = OTHERS
        self._counts[word] = self._counts.get(word, 0) + count

    def total(self) -> int:
        """All words together."""
        return sum(tuple(self._counts.values()))

    def most_common(self) -> list[tuple[str, int]]:
        """Words with their counts, the largest first."""
        return sorted(self.items(), key=lambda item: -item[1])

    def __getitem__(self, word: str) -> int:
        return self._counts.get(word, 0)

    def __contains__(self, word: object) -> bool:
        return word in self._counts

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._counts))

    def __len__(self) -> int:
        return len(self._counts)

    def __repr__(self) -> str:
        return f'{type(self).__name__}({self._counts!r})'
