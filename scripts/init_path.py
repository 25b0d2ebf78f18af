"""`import init_path` beside this file: the repository's packages are found without being installed."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
