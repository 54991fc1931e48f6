/* The control loop without its clock: mailboxes, driver, control tick and log. No lock, no allocation, no waiting.
 *
 * One thread calls dbk_control_loop_tick; one other thread calls the rest. An input that is late or missing is a
 * condition of the supervisor: without a new nominal control for `control_valid` the arm holds (heartbeat_lost), and an
 * old scene slows and then stops it.
 */
#ifndef DBK_CONTROL_LOOP_H
#define DBK_CONTROL_LOOP_H

#include "dbk_control_tick.h"
#include "drivers/dbk_driver.h"
#include "mailboxes/dbk_latest.h"
#include "mailboxes/dbk_ring.h"

#define DBK_LOG_CAPACITY 4096u
#define DBK_STOP_LIMIT_US 2000000u /* after a request to stop, the drive is off after this time at the latest */

typedef struct {
  dbk_control_tick tick;
  dbk_driver driver;
  dbk_latest controls, scenes;
  dbk_nominal_control control[3];
  dbk_stamped_scene scene[3];
  /* written by the other thread */
  uint64_t held_conditions, pressed_conditions; /* such as ESTOP while it is pressed; buttons */
  uint64_t speed_scale_bits;                    /* of a double */
  uint32_t called;                              /* 1: the caller has called since the last tick */
  uint32_t stop_requested, drive_off;
  uint64_t refused; /* controls that were refused before they entered */
  /* of the loop */
  uint64_t ticks, control_us, called_us, stop_us, refused_seen;
  uint32_t has_called;     /* 1: the caller has called once */
  uint64_t own_conditions; /* detected by the loop since the other thread took them */
  uint32_t finished; /* 1: the drive is off after a request to stop */
  dbk_ring log;
  dbk_tick_record record[DBK_LOG_CAPACITY];
} dbk_control_loop;

/* `tick` has its models and limits; the scene is unusable until the first one arrives, so that the arm does not move */
void dbk_control_loop_init(dbk_control_loop *l, dbk_driver driver);

/* one tick at `now_us`; the thread passes its lateness and the duration of the last tick */
void dbk_control_loop_tick(dbk_control_loop *l, uint64_t now_us, uint32_t wake_late_us, uint32_t last_work_us);

/* Replaces the nominal control [rad/s]. `standstill`: the arm is at rest and stays there, and the filter does not move it.
 * Returns 0 if it is refused, because it is not finite. */
int dbk_control_loop_submit_control(dbk_control_loop *l, const double *u, int standstill, uint64_t number);

/* Shows that the caller runs. If a call is not followed by another one within `caller_lost_after`, the arm is stopped
 * (tick_lost). The time begins with the first plausible state. */
void dbk_control_loop_call(dbk_control_loop *l);

/* the conditions that the loop detected since the last call, without those from outside */
uint64_t dbk_control_loop_take_conditions(dbk_control_loop *l);

/* the slot for the next scene, and its publication */
dbk_stamped_scene *dbk_control_loop_scene_slot(dbk_control_loop *l);
void dbk_control_loop_submit_scene(dbk_control_loop *l);

/* sets conditions that last until they are cleared, such as DBK_CONDITION_ESTOP */
void dbk_control_loop_hold(dbk_control_loop *l, uint64_t conditions, int held);

/* presses buttons for one tick */
void dbk_control_loop_press(dbk_control_loop *l, uint64_t buttons);

/* scale in (0, 1] of the nominal control; returns 0 if it is refused */
int dbk_control_loop_set_speed(dbk_control_loop *l, double scale);

/* Switches the drive off at the next tick, and on again once the arm is at rest; the caller knows why, so neither is a
 * condition. */
void dbk_control_loop_set_drive(dbk_control_loop *l, int on);

/* brings the arm to rest and switches the drive off */
void dbk_control_loop_request_stop(dbk_control_loop *l);

#endif
