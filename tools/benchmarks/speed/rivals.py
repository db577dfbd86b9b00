"""Others on the same scans, each in a process of its own; run by `throughput`, with the interpreter that has them.

    python tools/benchmarks/speed/rivals.py kiss-icp-1|kiss-icp|kiss-slam DATA SEQUENCE FIRST LAST

KISS-ICP with one thread and with its default, and KISS-SLAM, read KITTI by KISS-ICP's reader. Prints JSON.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np
from kiss_icp.datasets.kitti import KITTIOdometryDataset

Step = Callable[[np.ndarray, np.ndarray], object]


def kiss_icp(*, threads: int) -> Step:
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.registration.max_num_threads = threads
    return KissICP(config).register_frame


def kiss_slam() -> Step:
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    return KissSLAM(load_config(None)).process_scan


RIVALS = {"kiss-icp-1": lambda: kiss_icp(threads=1), "kiss-icp": lambda: kiss_icp(threads=0), "kiss-slam": kiss_slam}


def main() -> None:
    name, data, sequence, first, last = sys.argv[1:]
    dataset = KITTIOdometryDataset(data, sequence)
    step = RIVALS[name]()
    began, cpu_began, times = time.perf_counter(), time.process_time(), []
    for index in range(int(first), int(last)):
        scan = dataset[index]
        started = time.perf_counter()
        step(*scan)
        times.append(1e3 * (time.perf_counter() - started))
    seconds = time.perf_counter() - began
    print(
        json.dumps(
            {
                "scans_per_second": len(times) / seconds,
                "cpu_ms_per_scan": 1e3 * (time.process_time() - cpu_began) / len(times),
                "ms": {"median": float(np.median(times)), "p95": float(np.percentile(times, 95))},
            }
        )
    )


if __name__ == "__main__":
    main()
