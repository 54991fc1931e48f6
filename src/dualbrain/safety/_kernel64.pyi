from dualbrain.safety._kernel import Kernel as Kernel
from dualbrain.safety._kernel import distance as distance
from dualbrain.safety._kernel import flags as flags
from dualbrain.safety._kernel import real as real
from dualbrain.safety._kernel import sincos as sincos
from dualbrain.safety._kernel import solve_qp as solve_qp
from dualbrain.safety._kernel import source_hash as source_hash
