/* Cyclic executive: receives messages, decides, filters, and answers. It is independent of the board.
 *
 * One CYCLE: conditions of the host and of the target -> supervisor -> nominal control (zero from HOVER on) -> filter ->
 * control (zero at a standstill) and drive enable. The host cannot lower a decision of the target, except while
 * it reports that the arm yields to a contact: conditions only add up, and the buttons that clear them are conditions of
 * authenticated messages.
 */
#ifndef FIRMWARE_EXECUTIVE_H
#define FIRMWARE_EXECUTIVE_H

#include "dbk/dbk_cycle.h"
#include "protocol/frame.h"
#include "protocol/messages.h"

#define STATE_STALE_US 50000u  /* without a CYCLE for this time the arm brakes (controlled stop) */
#define STATE_LOST_US 150000u  /* without a CYCLE for this time the drive is switched off */
#define CYCLES_AHEAD 4u        /* most CYCLEs that may come before their time */
#define RESET_PERIODS 2.01f    /* a RESET may change the control by the acceleration of two periods, and rounding */

/* the tables of the robot and the key, linked into the firmware */
extern dbk_model robot_hull_model; /* the spheres of the fingers cover every opening of the gripper */
#ifdef PROFILE_SMALL
#define robot_model robot_hull_model /* the opening of the gripper counts as unknown */
#else
extern dbk_model robot_model;
#endif
extern const uint64_t robot_hash, kernel_hash;
extern const siphash_key shared_key;
extern const char board_name[15];

typedef struct {
  uint32_t last_sequence;
  siphash_key key;
  uint8_t open;      /* a HELLO has been accepted */
  uint8_t cycling;   /* a CYCLE has been accepted */
} session_state;

/* parts of the scene that are not valid until a message of their kind has been accepted */
enum { OBSTACLES_MISSING = 1, HELD_MISSING = 2, ROWS_MISSING = 4 };

typedef struct {
  dbk_scene scene;
  uint8_t missing; /* the parts that are missing; with any of them every step brakes */
  dbk_obstacle staged[DBK_MAX_OBSTACLES];
  uint32_t n_staged, n_announced;
  uint8_t transferring;
  dbk_cycle cycle;
  session_state session;
  frame_reader reader;
  uint64_t cycle_us;                      /* time of the last CYCLE by the clock of the target */
  uint64_t output_us;                     /* time of the last output of the watchdog */
  uint64_t due_us;                        /* time at which the next CYCLE is due if none comes too early */
  uint64_t host_now_us, last_stamp_us;
  uint32_t refused;
  uint8_t drive_on;
  uint8_t reset_waits; /* a RESET takes effect in the next CYCLE, whose state it must agree with */
  dbk_real reset_u[DBK_MAX_DOF], reset_change[DBK_MAX_DOF];
} executive;

void executive_init(executive *e);

/* receives one byte of the link; answers over hal_tx. Returns 1 at the end of a frame */
int executive_receive(executive *e, uint8_t byte);

/* the watchdog, called at least once per millisecond: without a CYCLE in time the arm brakes, with one output per
 * control period, and the drive goes off */
void executive_watchdog(executive *e, uint64_t now_us);

#endif
