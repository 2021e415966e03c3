"""Processes for trials side by side, which end with the one that started them."""

import concurrent.futures
import multiprocessing
import multiprocessing.connection
import os
import threading


def pool(processes: int) -> concurrent.futures.ProcessPoolExecutor:
    """Processes of their own (JAX does not support fork)."""
    return concurrent.futures.ProcessPoolExecutor(
        processes, multiprocessing.get_context("spawn"), initializer=_end_with_parent
    )


def _end_with_parent() -> None:
    """End this process when its parent is killed: the executor's queue would have it wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
