"""Made-up figures of benchmarks."""

from gigabrain_zenoh.qa.bench.chain import RateComparison
from gigabrain_zenoh.qa.judging import Latencies


def one(n: int, p50_ms: float, p99_ms: float) -> Latencies:
    return Latencies(n=n, p50_ms=p50_ms, p99_ms=p99_ms)


def compared() -> RateComparison:
    return RateComparison(
        rate_hz=10.0,
        chain=(one(100, 0.9, 3.0), one(99, 0.6, 1.0), one(101, 0.7, 1.5)),
        relay=(one(100, 0.5, 0.9), one(100, 0.4, 0.8), one(100, 0.6, 1.1)),
        peers=one(100, 0.25, 0.5),
    )
