/* Data that enters and leaves the control thread: joint states, commands, nominal controls, limits, and tick records. */
#ifndef DBK_CONTROL_DATA_H
#define DBK_CONTROL_DATA_H

#include "dbk/dbk.h"

typedef struct {
  uint64_t sequence, stamp_us;
  double q[DBK_MAX_DOF], v[DBK_MAX_DOF]; /* [rad], [rad/s] */
  double opening;                        /* of a finger [m]; NaN: unknown */
  int32_t drive_enabled;
  int32_t has_desired; /* 1: the robot reports the command that it executes, also where it continued a lost one */
  double desired_v[DBK_MAX_DOF], desired_a[DBK_MAX_DOF]; /* [rad/s], [rad/s^2] */
} dbk_joint_state;

typedef struct {
  uint64_t tick, now_us;
  double u[DBK_MAX_DOF]; /* [rad/s]; valid until the next command */
  int32_t drive_enable;
} dbk_joint_command;

typedef struct {
  uint64_t number;
  double u[DBK_MAX_DOF]; /* [rad/s] */
  int32_t standstill;    /* 1: the arm is to stay at rest; the filter does not move it */
} dbk_nominal_control;

typedef struct {
  uint64_t number;
  double stamp; /* [s] of the last observation */
  dbk_scene scene;
} dbk_stamped_scene;

/* limits of the checks, as `Timing`, `MonitorLimits` and the joints of the robot; times in s */
typedef struct {
  double period, command_period; /* of the loop; of a command, to which the limits of the robot refer */
  double tick_lost_after, state_stale_after, state_lost_after, max_loop_delay, max_clock_skew;
  double drive_on_timeout, drive_on_silence;
  double control_valid;   /* a nominal control stays in force for this time */
  double caller_lost_after; /* time without a call of the caller; infinite: not checked */
  double scene_old_after;   /* age of a scene with moving objects */
  double max_source_gap, max_tracking_gap, tracking_lost_gap, leak_time, max_position_jump, lag;
  double rest_velocity, slow_scale;
  double opening_max; /* of the gripper; < 0: without fingers */
  double q_least[DBK_MAX_DOF], q_most[DBK_MAX_DOF];
  double overspeed[DBK_MAX_DOF], control_limit[DBK_MAX_DOF], velocity_limit[DBK_MAX_DOF], braking_step[DBK_MAX_DOF];
} dbk_control_limits;

/* everything that decided one tick, and its result */
typedef struct {
  uint64_t tick, now_us, scene_number, control_number;
  uint64_t external;   /* conditions from outside the tick: buttons, late inputs */
  uint64_t conditions; /* all conditions of the decision */
  dbk_joint_state state;
  double u_nom[DBK_MAX_DOF]; /* before the scale of the decision */
  double u[DBK_MAX_DOF];     /* the control that is written */
  double speed_scale, delta, h_min;
  int32_t new_state, state_used; /* 1: a state arrived; 1: it was plausible */
  int32_t drive_off;             /* 1: the caller wants the drive off, or did and the arm is not at rest yet */
  int32_t standstill;            /* 1: the caller wants the arm to stay at rest */
  int32_t continued;             /* 1: the robot executed another command than the last one */
  int32_t status, flags, certified, iterations, n_rows;
  int32_t action, check, drive_enable, at_standstill;
  uint32_t wake_late_us, work_us; /* of the thread; 0 if the tick was called directly */
} dbk_tick_record;

#endif
