"""python -m mjx_cl"""

import sys

from mjx_cl.cli.app import main

sys.exit(main())
