"""Who wants to be alone is, and is not kept waiting by those who come after."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from turns import turn


def test_alone_is_alone_and_comes_before_who_comes_later(tmp_path: Path) -> None:
    told: list[str] = []
    first = turn(tmp_path, alone=False)
    first.__enter__()

    def enter(name: str, *, alone: bool) -> None:
        with turn(tmp_path, alone=alone):
            told.append(f"{name} in")
            time.sleep(0.05)
            told.append(f"{name} out")

    with turn(tmp_path, alone=False):  # two may be in together
        pass
    threads = []
    for name, alone in (("flood", True), ("run", False)):
        threads.append(threading.Thread(target=enter, args=(name,), kwargs={"alone": alone}))
        threads[-1].start()
        time.sleep(0.2)  # the order in which they come
    assert told == []
    first.__exit__(None, None, None)
    for thread in threads:
        thread.join()
    assert told == ["flood in", "flood out", "run in", "run out"]
