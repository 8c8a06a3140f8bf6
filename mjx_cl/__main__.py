"""python -m mjx_cl"""

import sys

from mjx_cl.cli import main

sys.exit(main())
