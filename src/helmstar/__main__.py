"""`python -m helmstar`."""

import sys

from .cli import main

sys.exit(main())
