"""python tests/fuzz/fuzz_notes.py -runs=100000"""

from harness import fuzz

if __name__ == "__main__":
    fuzz("notes")
