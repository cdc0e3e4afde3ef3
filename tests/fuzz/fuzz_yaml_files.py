"""python tests/fuzz/fuzz_yaml_files.py -runs=100000"""

from harness import fuzz

if __name__ == "__main__":
    fuzz("yaml_files")
