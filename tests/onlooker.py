"""The fault suite's onlooker, for tests."""

from gigabrain_zenoh.qa.faults.onlooker import SYSTEMS, Onlooker, at_rest, looking_on

__all__ = ["SYSTEMS", "Onlooker", "at_rest", "looking_on"]
