/* One control tick without a clock and without I/O: state, nominal control and scene -> control.
 *
 * It decides as `SafetyController` of `dualbrain.safety.supervisor` for an arm with a fixed base: equal inputs give equal
 * decisions and equal bits of the control.
 */
#ifndef DBK_CONTROL_TICK_H
#define DBK_CONTROL_TICK_H

#include "checks/dbk_loop_timing.h"
#include "checks/dbk_state_monitor.h"
#include "dbk/dbk_cycle.h"
#include "dbk_control_data.h"

typedef struct {
  dbk_model model, hull_model; /* the second covers every opening of the gripper */
  dbk_control_limits limits;
  dbk_cycle cycle;
  dbk_state_monitor monitor;
  dbk_loop_timing timing;
  dbk_joint_state state; /* the last plausible one */
  int32_t has_state, drive_came_on, drive_off;
  double drive_request_stamp, drive_request_time; /* [s] */
  double u[DBK_MAX_DOF];                          /* the control that was written last */
} dbk_control_tick;

/* both models are prepared and checked by the caller, and the limits are set */
void dbk_control_tick_init(dbk_control_tick *t);

/* Runs the tick of `record`, whose inputs are set: now_us, new_state, state, u_nom, speed_scale, external, drive_off and
 * standstill. Sets its results. `drive_off` switches the drive off without a fault: its absence is no condition until the
 * drive is wanted again. It comes on again only at rest; until then the result has `drive_off`, too. Returns 0, without a
 * result, before the first plausible state: no command may be written. */
int dbk_control_tick_run(dbk_control_tick *t, const dbk_stamped_scene *scene, dbk_tick_record *record);

#endif
