"""The live node with a solver that knows the motion of a turning camera, but not its sign."""

import sys

from depth_deblur_ros.node import DeblurNode, main
from turning import Knowing


class TurningNode(DeblurNode):
    def __init__(self):
        super().__init__(solve=Knowing(), first=lambda: None)


if __name__ == '__main__':
    sys.exit(main(node_type=TurningNode))
