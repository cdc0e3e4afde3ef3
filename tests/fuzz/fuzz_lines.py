"""python tests/fuzz/fuzz_lines.py -runs=100000"""

from harness import fuzz

if __name__ == "__main__":
    fuzz("lines")
