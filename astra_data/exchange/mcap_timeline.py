"""Messages of MCAP files by their log times, which may come twice where a clock was set back.

A file is in the order in which its messages were recorded, but for a little: chunks and several publishers.
Where a topic goes back by more than `split.gap_s`, the clock did, and a new stretch begins for all topics.
Where this is so for over one in `FEWEST` messages, it is no clock: the file is out of order, and sorted.
"""

from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator
from heapq import heappop, heappush
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from astra_data.exchange.mcap_file import McapFile

FEWEST = 10
"""Messages to a step back of the clock."""


class McapMessage(NamedTuple):
    """A message.

    Attributes:
        topic: where it was sent.
        time: when, in ns, on a clock that only goes forward.
        log_time: when by the recorder's clock.
        content: the decoded message.
        is_back: whether it is the first after the clock was set back.
    """

    topic: str
    time: int
    log_time: int
    content: Any
    is_back: bool


class _Stretch:
    """What comes in a file before its clock goes back, or until its end.

    Attributes:
        times: topic to the log times of its messages, in ns, in the file's order.
        latest: the largest of them.
        late_ns: how far they are out of order.
    """

    def __init__(self) -> None:
        """Begin it."""
        self.times: defaultdict[str, array[int]] = defaultdict(lambda: array("Q"))
        self.latest = 0
        self.late_ns = 0

    def add(self, topic: str, time: int) -> None:
        """Add a message."""
        self.times[topic].append(time)
        if time >= self.latest:
            self.latest = time
        elif self.latest - time > self.late_ns:
            self.late_ns = self.latest - time

    @property
    def earliest(self) -> int:
        """The smallest of the times."""
        return min(map(min, self.times.values()))

    def __len__(self) -> int:
        """Return how many messages it has."""
        return sum(map(len, self.times.values()))


class Timeline:
    """The messages of an MCAP file by their times.

    Attributes:
        moments: topic to the times of its messages in ns, as `McapMessage.time`, in their order.
    """

    def __init__(self, file: McapFile, gap_s: float, pause_s: float) -> None:
        """Find out when messages come, by reading the file once.

        Args:
            file: has all topics that are wanted.
            gap_s: by how much a topic may go back while the clock does not.
            pause_s: what is longer between messages ends an episode in any case.

        Raises:
            BadInputError: the file lacks topics; lists all of them.
        """
        self._file = file
        self._gap_ns = round(gap_s * 1e9)
        self._pause_ns = 2 * round(pause_s * 1e9) + 1
        self._stretches = self._survey()
        file.check_topics()
        self._shifts = self._shifted()
        self.moments = self._moments()

    def messages(self) -> Iterator[McapMessage]:
        """Yield the messages, by their times, and in the file's order where these are equal.

        Only those that may be out of order are held in memory.

        Raises:
            BadInputError: messages have an encoding that cannot be read.
        """
        held: list[tuple[int, int, str, Any]] = []
        decoders: dict[int, Callable[[bytes], Any]] = {}
        messages = enumerate(self._file.messages(checked=True))
        for at, stretch in enumerate(self._stretches):
            is_back, latest = at > 0, 0
            for left in range(len(stretch) - 1, -1, -1):
                number, (topic, message) = next(messages)
                heappush(held, (message.log_time, number, topic, message))
                latest = max(latest, message.log_time)
                while held and (held[0][0] <= latest - stretch.late_ns or not left):
                    time, _, topic, message = heappop(held)
                    number = message.channel_id
                    if number not in decoders:
                        decoders[number] = self._file.decoder(number)
                    content = decoders[number](message.data)
                    yield McapMessage(topic, time + self._shifts[at], time, content, is_back)
                    is_back = False
        next(messages, None)  # the sums at the end of the file

    def _survey(self) -> list[_Stretch]:
        stretches = [_Stretch()]
        highest: dict[str, int] = {}
        for topic, message in self._file.messages(checked=False):
            time = message.log_time
            if time < highest.get(topic, 0) - self._gap_ns:
                stretches.append(_Stretch())
                highest = {}
            highest[topic] = max(time, highest.get(topic, 0))
            stretches[-1].add(topic, time)
        if sum(map(len, stretches)) >= FEWEST * (len(stretches) - 1):
            return stretches
        whole = _Stretch()
        for stretch in stretches:
            for topic, times in stretch.times.items():
                whole.times[topic] += times
        whole.latest = max(stretch.latest for stretch in stretches)
        whole.late_ns = whole.latest - whole.earliest
        return [whole]

    def _shifted(self) -> list[int]:
        """Return what to add to the times of each stretch, so that it begins a pause after the one before."""
        shifts = [0]
        for before, stretch in pairwise(self._stretches):
            shifts.append(before.latest + shifts[-1] + self._pause_ns - stretch.earliest)
        return shifts

    def _moments(self) -> dict[str, NDArray[np.int64]]:
        parts: defaultdict[str, list[NDArray[np.int64]]] = defaultdict(list)
        for stretch, shift in zip(self._stretches, self._shifts, strict=True):
            for topic, times in stretch.times.items():
                parts[topic].append(np.sort(np.asarray(times, np.int64)) + shift)
        return {topic: np.concatenate(each) for topic, each in parts.items()}
