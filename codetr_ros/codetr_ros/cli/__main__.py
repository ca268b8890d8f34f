"""`python -m codetr_ros.cli` is the command `codetr`."""

import sys

from codetr_ros.cli import main

if __name__ == '__main__':
    sys.exit(main())
