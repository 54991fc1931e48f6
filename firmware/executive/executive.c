/* Cyclic executive; see executive.h. */
#include "executive/executive.h"

#include "executive/scene_messages.h"
#include "port/hal.h"
#include "protocol/bytes.h"

static void read_joints(const uint8_t *from, dbk_real *to) {
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { to[k] = k < robot_model.n ? read_f32(from + 4 * k) : (dbk_real)0; }
}

static uint32_t period_us(void) { return (uint32_t)(robot_model.period * (dbk_real)1e6 + (dbk_real)0.5); }

void executive_init(executive *e) {
  dbk_prepare(&robot_hull_model);
#ifndef PROFILE_SMALL
  dbk_prepare(&robot_model);
#endif
  dbk_scene_clear(&e->scene);
  e->missing = 0;
  scene_make_unusable(e); /* until the host has sent a scene */
  dbk_cycle_init(&e->cycle);
  frame_reader_clear(&e->reader);
  e->session.open = e->session.cycling = e->transferring = e->drive_on = e->reset_waits = 0;
  e->n_staged = e->n_announced = e->refused = 0;
  e->cycle_us = e->output_us = e->due_us = e->host_now_us = e->last_stamp_us = 0;
}

static void send(uint8_t type, uint32_t sequence, const uint8_t *payload, uint32_t size, const siphash_key *key) {
  uint8_t encoded[FRAME_MAX_ENCODED];
  hal_tx(encoded, frame_encode(type, sequence, payload, size, key, encoded));
}

/* the key of a session: both nonces are its input, so that no message of another session is accepted */
static siphash_key session_key(uint64_t host_nonce, uint64_t target_nonce) {
  uint8_t b[17];
  siphash_key key;
  write_u64(b + 1, host_nonce);
  write_u64(b + 9, target_nonce);
  b[0] = 0;
  key.low = siphash(&shared_key, b, sizeof b);
  b[0] = 1;
  key.high = siphash(&shared_key, b, sizeof b);
  return key;
}

static void answer_hello(executive *e, const frame *f) {
  uint8_t b[HELLO_REPLY_SIZE];
  const uint64_t nonce = hal_nonce();
  write_u64(b, nonce);
  write_u64(b + 8, robot_hash);
  write_u64(b + 16, kernel_hash);
  b[24] = (uint8_t)robot_model.n;
  write_u16(b + 25, (uint16_t)DBK_MAX_OBSTACLES);
  for (uint32_t i = 0; i < 15u; ++i) { b[27 + i] = (uint8_t)board_name[i]; }
#ifdef PROFILE_SMALL
  b[42] = 0;
#else
  b[42] = 1;
#endif
  send(MESSAGE_HELLO_REPLY, f->sequence, b, sizeof b, &shared_key);
  e->session.key = session_key(read_u64(f->payload), nonce);
  e->session.last_sequence = f->sequence;
  e->session.open = 1;
  scene_make_unusable(e);
  e->transferring = e->reset_waits = 0;
}

/* a HELLO for other robot tables is answered, so that the host can name both hashes, but it opens no session */
static int hello(executive *e, const frame *f) {
  if (f->payload_size != 16u || !frame_tag_valid(f, &shared_key)) { return 0; }
  answer_hello(e, f);
  if (read_u64(f->payload + 8) != robot_hash) {
    e->session.open = 0;
    return 0;
  }
  return 1;
}

static void write_reply(const executive *e, const dbk_real *u, uint32_t step_us, uint8_t *b) {
  const dbk_out *out = &e->cycle.out;
  write_u64(b + REPLY_CONDITIONS, e->cycle.pending | (hal_estop_in() ? DBK_CONDITION_ESTOP : 0));
  for (uint32_t k = 0; k < MESSAGE_JOINTS; ++k) { write_f32(b + REPLY_U + 4u * k, u[k]); }
  write_f32(b + REPLY_DELTA, out->delta);
  write_f32(b + REPLY_DELTA + 4u, out->delta_rows);
  write_f32(b + REPLY_DELTA + 8u, out->delta_box);
  write_f32(b + REPLY_DELTA + 12u, out->h_min);
  write_u32(b + REPLY_FLAGS, (uint32_t)out->flags);
  write_u32(b + REPLY_REFUSED, e->refused);
  write_u16(b + REPLY_ITERATIONS, (uint16_t)out->iterations);
  write_u16(b + REPLY_ROWS, (uint16_t)out->n_rows);
  b[REPLY_STATUS] = (uint8_t)out->status;
  b[REPLY_CERTIFIED] = (uint8_t)out->certified;
  b[REPLY_RELAXED] = (uint8_t)out->relaxed;
  b[REPLY_ACTION] = e->cycle.supervisor.decision.action;
  b[REPLY_CHECK] = e->cycle.supervisor.decision.check;
  b[REPLY_DRIVE] = e->drive_on;
  b[REPLY_STANDSTILL] = e->cycle.standstill.at_standstill;
  b[REPLY_STANDSTILL + 1u] = 0;
  write_u32(b + REPLY_STEP_TIME, step_us);
}

static void count_refusal(executive *e) {
  ++e->refused;
  e->cycle.pending |= DBK_CONDITION_FRAMES_REFUSED;
}

/* the filter step under the decision in force, and the drive */
static void filter(executive *e, const dbk_model *model, dbk_real *u) {
  (void)dbk_cycle_filter(&e->cycle, model, &e->scene, u);
  e->drive_on = e->cycle.standstill.drive_wanted;
  hal_drive_enable(e->drive_on);
}

/* the decision of this tick from the conditions of the host and of the target */
static void decide(executive *e, uint64_t now_us, uint64_t stamp_us, uint64_t conditions, uint32_t options) {
  conditions |= hal_estop_in() ? DBK_CONDITION_ESTOP : 0;
  (void)dbk_cycle_decide(&e->cycle, robot_model.n, now_us, stamp_us, conditions, (options & CYCLE_YIELDING) != 0u);
}

static void read_cycle(executive *e, const uint8_t *b) {
  const uint32_t options = read_u32(b + CYCLE_OPTIONS);
  read_joints(b + CYCLE_Q, e->cycle.in.q);
  read_joints(b + CYCLE_V, e->cycle.in.v);
  read_joints(b + CYCLE_U_NOM, e->cycle.in.u_nom);
  e->cycle.in.opening = read_f32(b + CYCLE_OPENING);
  e->cycle.in.state_age = read_f32(b + CYCLE_STATE_AGE);
  e->cycle.in.scene_age = read_f32(b + CYCLE_SCENE_AGE);
  e->cycle.in.mobile = (options & CYCLE_MOBILE) != 0u;
  for (uint32_t i = 0; i < 9u; ++i) { e->cycle.in.base_rotation[i] = read_f32(b + CYCLE_BASE + 4u * i); }
  for (uint32_t i = 0; i < 3u; ++i) { e->cycle.in.base_position[i] = read_f32(b + CYCLE_BASE + 36u + 4u * i); }
}

static int cycle(executive *e, const frame *f) {
  uint8_t reply[REPLY_SIZE];
  dbk_real u[DBK_MAX_DOF];
  if (f->payload_size != CYCLE_SIZE) { return 0; }
  const uint8_t *b = f->payload;
  const uint64_t started_us = hal_now(), now_us = read_u64(b + CYCLE_NOW), stamp_us = read_u64(b + CYCLE_STAMP);
  read_cycle(e, b);
  decide(e, now_us, stamp_us, read_u64(b + CYCLE_CONDITIONS), read_u32(b + CYCLE_OPTIONS));
  if (!reset_apply(e)) { count_refusal(e); }
  filter(e, read_u32(b + CYCLE_OPTIONS) & CYCLE_OPENING_KNOWN ? &robot_model : &robot_hull_model, u);
  e->host_now_us = now_us;
  e->last_stamp_us = stamp_us;
  e->cycle_us = hal_now();
  e->session.cycling = 1;
  write_reply(e, u, (uint32_t)(e->cycle_us - started_us), reply);
  send(MESSAGE_CYCLE_REPLY, f->sequence, reply, REPLY_SIZE, &e->session.key);
  return 1;
}

/* Whether a CYCLE comes at its time by the clock of the target, or at most CYCLES_AHEAD periods before. Every cycle may
 * change the control by one period's acceleration, so a host that sends them faster would exceed the limit of the arm.
 * The clocks may differ by 1/64. In lockstep with a simulation the time passes with the messages. */
static int cycle_is_due(executive *e, uint64_t now_us) {
#ifdef LOCKSTEP
  (void)e;
  (void)now_us;
#else
  const uint32_t period = period_us();
  const uint64_t due_us = e->due_us > now_us ? e->due_us : now_us;
  if (due_us - now_us > (uint64_t)CYCLES_AHEAD * period) { return 0; }
  e->due_us = due_us + period - period / 64u;
#endif
  return 1;
}

/* a frame of the session: authenticated, and newer than the last one */
static int session_message(executive *e, const frame *f) {
  if (!e->session.open || f->sequence <= e->session.last_sequence || !frame_tag_valid(f, &e->session.key)) {
    return 0;
  }
  e->session.last_sequence = f->sequence;
  if (f->type != MESSAGE_CYCLE) { return scene_message_apply(e, f); }
  if (cycle_is_due(e, hal_now())) { return cycle(e, f); }
  if (f->payload_size == CYCLE_SIZE) { /* a stop counts at any time */
    e->cycle.pending |= read_u64(f->payload + CYCLE_CONDITIONS) & ~DBK_CONDITION_BUTTONS;
  }
  return 0;
}

int executive_receive(executive *e, uint8_t byte) {
  frame f;
  if (!frame_reader_add(&e->reader, byte)) { return 0; }
  const int accepted = frame_parse(&e->reader, &f) == FRAME_OK &&
                       (f.type == MESSAGE_HELLO ? hello(e, &f) : session_message(e, &f));
  frame_reader_clear(&e->reader);
  if (!accepted) { count_refusal(e); }
  return 1;
}

/* one output without a CYCLE: the filter rejects the old state, and its control brakes */
static void output_without_host(executive *e, uint64_t since_us, uint64_t now_us) {
  uint8_t reply[REPLY_SIZE];
  dbk_real u[DBK_MAX_DOF];
  const uint64_t lost = since_us > STATE_LOST_US ? DBK_CONDITION_STATE_LOST : 0;
  const uint32_t age_us = since_us < UINT32_MAX ? (uint32_t)since_us : UINT32_MAX; /* a 64-bit conversion needs a library */
  e->cycle.in.state_age = (dbk_real)age_us * (dbk_real)1e-6;
  decide(e, e->host_now_us + since_us, e->last_stamp_us, DBK_CONDITION_STATE_STALE | lost, 0);
  filter(e, &robot_hull_model, u);
  e->output_us = now_us;
  write_reply(e, u, 0, reply);
  send(MESSAGE_OUTPUT, e->session.last_sequence, reply, REPLY_SIZE, &e->session.key);
}

/* Every output may change the control by one period's acceleration, so they follow at the control period. */
void executive_watchdog(executive *e, uint64_t now_us) {
  if (!e->session.cycling || now_us < e->cycle_us) { return; }
  const uint64_t since_us = now_us - e->cycle_us;
  if (since_us > STATE_STALE_US && now_us - e->output_us >= period_us()) { output_without_host(e, since_us, now_us); }
}
