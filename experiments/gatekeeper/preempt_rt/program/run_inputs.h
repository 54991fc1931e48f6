/* Robot and limits of the run; `c_inputs.py` and `dualbrain robot export-c` write their values as C sources. */
#ifndef RUN_INPUTS_H
#define RUN_INPUTS_H

#include "dbk_control_data.h"

extern dbk_model robot_model, robot_hull_model;
extern const dbk_control_limits control_limits;
extern const double arm_home[DBK_MAX_DOF], arm_braking[DBK_MAX_DOF], arm_lag; /* [rad], [rad/s^2], [s] */

#endif
