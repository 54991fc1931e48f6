/* Messages between the host and the target: types, and the layout of the payloads (little-endian, without padding).
 *
 * Host to target. HELLO begins a session, and only CYCLE and HELLO are answered. A message that is refused counts in
 * `refused` of the next reply; one that would have replaced a part of the scene leaves this part unusable, so that the robot brakes
 * until a valid one of the same part.
 *
 *   HELLO          host nonce u64, hash of the robot tables u64
 *   SCENE_BEGIN    number of obstacles u16
 *   OBSTACLES      index of the first u16, number u16, OBSTACLE_SIZE bytes each
 *   SCENE_END      (empty) the new obstacles replace the former ones; no contact is permitted
 *   PERMITS        number u16, then link u8, zero u8, obstacle u16, speed f32 [m/s] each
 *   HELD           number u16, zero u16, position error f32 [m], then x, y, z, radius f32 [m] each, in the last frame
 *   ROWS           number u16, zero u16, then a 8 f32, b f32, h f32, rank u32 each
 *   RESET          last control 8 f32, its last change 8 f32; takes effect in the next CYCLE, and is refused there if it
 *                  is neither near the control of the target nor near the measured velocity, or faster under a HOVER
 *   CYCLE          see the offsets below
 *
 * Target to host.
 *
 *   HELLO_REPLY    target nonce u64, hash of the robot tables u64, hash of the kernel u64, joints u8, capacity: obstacles
 *                  u16, board name 15 bytes, tables for a known opening u8; its tag is that of the shared key, all later tags are those of the session
 *   CYCLE_REPLY    see the offsets below; its sequence is that of the CYCLE
 *   OUTPUT         as CYCLE_REPLY; sent without a CYCLE when the watchdog acts
 */
#ifndef FIRMWARE_MESSAGES_H
#define FIRMWARE_MESSAGES_H

enum {
  MESSAGE_HELLO = 0x01,
  MESSAGE_SCENE_BEGIN = 0x02,
  MESSAGE_OBSTACLES = 0x03,
  MESSAGE_SCENE_END = 0x04,
  MESSAGE_PERMITS = 0x05,
  MESSAGE_HELD = 0x06,
  MESSAGE_ROWS = 0x07,
  MESSAGE_RESET = 0x08,
  MESSAGE_CYCLE = 0x09,
  MESSAGE_HELLO_REPLY = 0x81,
  MESSAGE_CYCLE_REPLY = 0x89,
  MESSAGE_OUTPUT = 0x8A
};

#define MESSAGE_JOINTS 8u     /* joint arrays of all messages have this length */
#define OBSTACLE_SIZE 132u    /* shape, flags, rank, link_mask u32, then 29 f32 in the order of dbk_obstacle */
#define PERMIT_SIZE 8u
#define HELD_SIZE 16u
#define ROW_SIZE 44u

/* options of a CYCLE */
#define CYCLE_OPENING_KNOWN 1u
#define CYCLE_MOBILE 2u
#define CYCLE_YIELDING 4u /* the arm yields to a contact force; only with the check `unexpected_contact` */

#define CYCLE_NOW 0u          /* u64 [us] of the host */
#define CYCLE_STAMP 8u        /* u64 [us] of the joint state */
#define CYCLE_CONDITIONS 16u  /* u64 */
#define CYCLE_Q 24u           /* 8 f32 */
#define CYCLE_V 56u           /* 8 f32 */
#define CYCLE_U_NOM 88u       /* 8 f32 */
#define CYCLE_OPENING 120u    /* f32 */
#define CYCLE_STATE_AGE 124u  /* f32 [s] */
#define CYCLE_SCENE_AGE 128u  /* f32 [s] */
#define CYCLE_OPTIONS 132u    /* u32 */
#define CYCLE_BASE 136u       /* rotation 9 f32, position 3 f32 */
#define CYCLE_SIZE 184u

#define HELLO_REPLY_SIZE 43u

#define REPLY_CONDITIONS 0u   /* u64: conditions of the target for its next decision */
#define REPLY_U 8u            /* 8 f32 */
#define REPLY_DELTA 40u       /* delta, delta_rows, delta_box, h_min f32 */
#define REPLY_FLAGS 56u       /* u32 */
#define REPLY_REFUSED 60u     /* u32: frames refused since the start */
#define REPLY_ITERATIONS 64u  /* u16 */
#define REPLY_ROWS 66u        /* u16 */
#define REPLY_STATUS 68u      /* u8 */
#define REPLY_CERTIFIED 69u   /* u8 */
#define REPLY_RELAXED 70u     /* u8 */
#define REPLY_ACTION 71u      /* u8: action of the supervisor */
#define REPLY_CHECK 72u       /* u8: strongest tripped check */
#define REPLY_DRIVE 73u       /* u8: 1 if the drive is enabled */
#define REPLY_STANDSTILL 74u  /* u8: 1 if the control is that of a standstill */
#define REPLY_STEP_TIME 76u   /* u32: duration of the step [us] */
#define REPLY_SIZE 80u

#endif
