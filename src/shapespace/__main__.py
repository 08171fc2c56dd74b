"""`python -m shapespace` is the command line."""

import sys

from shapespace.cli import main

sys.exit(main())
