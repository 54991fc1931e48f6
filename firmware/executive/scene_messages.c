/* Messages that change the scene; see scene_messages.h. */
#include "executive/scene_messages.h"

#include "protocol/bytes.h"

static void read_reals(const uint8_t *from, dbk_real *to, int32_t count) {
  for (int32_t i = 0; i < count; ++i) { to[i] = read_f32(from + 4 * i); }
}

/* a part that is missing makes the scene unusable, also if another part arrives */
static void set_missing(executive *e, uint32_t part) {
  e->missing = (uint8_t)(e->missing | part);
  e->scene.ready = 0;
}

static void set_present(executive *e, uint32_t part) {
  e->missing = (uint8_t)(e->missing & ~part);
  dbk_scene_prepare(&e->scene);
  if (e->missing) { e->scene.ready = 0; }
}

void scene_make_unusable(executive *e) { set_missing(e, OBSTACLES_MISSING); }

static void clear_permits(dbk_scene *scene) {
  for (int32_t l = 0; l < DBK_ALL_LINKS; ++l) {
    for (int32_t o = 0; o < DBK_MAX_OBSTACLES; ++o) { scene->permit[l][o] = (dbk_real)-1; }
  }
}

static int begin(executive *e, const frame *f) {
  e->transferring = 0;
  if (f->payload_size != 2u || read_u16(f->payload) > DBK_MAX_OBSTACLES) { return 0; }
  e->n_announced = read_u16(f->payload);
  e->n_staged = 0;
  e->transferring = 1;
  return 1;
}

static void read_obstacle(const uint8_t *b, dbk_obstacle *o) {
  o->shape = (int32_t)read_u32(b);
  o->flags = (int32_t)read_u32(b + 4);
  o->rank = (int32_t)read_u32(b + 8);
  o->link_mask = read_u32(b + 12);
  read_reals(b + 16, &o->alpha, 1);
  read_reals(b + 20, o->position, 3);
  read_reals(b + 32, o->rotation, 9);
  read_reals(b + 68, o->half, 3);
  read_reals(b + 80, &o->radius, 1);
  read_reals(b + 84, o->velocity, 3);
  read_reals(b + 96, &o->margin, 1);
  read_reals(b + 100, &o->velocity_error, 1);
  read_reals(b + 104, &o->reaction, 1);
  read_reals(b + 108, &o->brake, 1);
  read_reals(b + 112, &o->approach, 1);
  read_reals(b + 116, &o->near_speed, 1);
  read_reals(b + 120, &o->near_distance, 1);
  read_reals(b + 124, &o->near_brake, 1);
  read_reals(b + 128, &o->near_approach, 1);
}

/* obstacles arrive in order and without gaps */
static int add_obstacles(executive *e, const frame *f) {
  if (!e->transferring || f->payload_size < 4u) { return 0; }
  const uint32_t first = read_u16(f->payload), count = read_u16(f->payload + 2);
  if (first != e->n_staged || count > e->n_announced - e->n_staged || f->payload_size != 4u + count * OBSTACLE_SIZE) {
    return 0;
  }
  for (uint32_t i = 0; i < count; ++i) {
    read_obstacle(f->payload + 4u + i * OBSTACLE_SIZE, &e->staged[e->n_staged++]);
  }
  return 1;
}

static int end(executive *e, const frame *f) {
  if (!e->transferring || f->payload_size != 0u || e->n_staged != e->n_announced) { return 0; }
  e->transferring = 0;
  for (uint32_t i = 0; i < e->n_staged; ++i) { e->scene.obstacle[i] = e->staged[i]; }
  e->scene.n_obstacles = (int32_t)e->n_staged;
  clear_permits(&e->scene);
  set_present(e, OBSTACLES_MISSING);
  return 1;
}

static int set_permits(executive *e, const frame *f) {
  clear_permits(&e->scene);
  if (f->payload_size < 2u) { return 0; }
  const uint32_t count = read_u16(f->payload);
  if (f->payload_size != 2u + count * PERMIT_SIZE) { return 0; }
  for (uint32_t i = 0; i < count; ++i) {
    const uint8_t *b = f->payload + 2u + i * PERMIT_SIZE;
    const uint32_t link = b[0], obstacle = read_u16(b + 2);
    const dbk_real speed = read_f32(b + 4);
    if (link > (uint32_t)robot_model.n_links || obstacle >= (uint32_t)e->scene.n_obstacles || b[1] != 0u ||
        !(speed >= (dbk_real)0 && speed <= (dbk_real)10)) {
      clear_permits(&e->scene);
      return 0;
    }
    e->scene.permit[link][obstacle] = speed;
  }
  return 1;
}

static int set_held(executive *e, const frame *f) {
  dbk_scene *scene = &e->scene;
  const uint32_t count = f->payload_size >= 8u ? read_u16(f->payload) : DBK_MAX_HELD + 1u;
  if (count > DBK_MAX_HELD || f->payload_size != 8u + count * HELD_SIZE) { return 0; }
  read_reals(f->payload + 4, &scene->held_error, 1);
  for (uint32_t i = 0; i < count; ++i) {
    const uint8_t *b = f->payload + 8u + i * HELD_SIZE;
    scene->held_x[i] = read_f32(b);
    scene->held_y[i] = read_f32(b + 4);
    scene->held_z[i] = read_f32(b + 8);
    scene->held_r[i] = read_f32(b + 12);
  }
  scene->n_held = (int32_t)count;
  set_present(e, HELD_MISSING);
  return 1;
}

static int set_rows(executive *e, const frame *f) {
  dbk_scene *scene = &e->scene;
  const uint32_t count = f->payload_size >= 4u ? read_u16(f->payload) : DBK_MAX_USER + 1u;
  if (count > DBK_MAX_USER || f->payload_size != 4u + count * ROW_SIZE) { return 0; }
  for (uint32_t r = 0; r < count; ++r) {
    const uint8_t *b = f->payload + 4u + r * ROW_SIZE;
    read_reals(b, scene->user_a[r], DBK_MAX_DOF);
    scene->user_b[r] = read_f32(b + 32);
    scene->user_h[r] = read_f32(b + 36);
    scene->user_rank[r] = (int32_t)read_u32(b + 40);
  }
  scene->n_user = (int32_t)count;
  set_present(e, ROWS_MISSING);
  return 1;
}

/* a last control that is not within the velocity limits is refused; any other one waits for the next CYCLE */
static int keep_reset(executive *e, const frame *f) {
  dbk_real u[DBK_MAX_DOF], change[DBK_MAX_DOF];
  if (f->payload_size != 64u) { return 0; }
  read_reals(f->payload, u, DBK_MAX_DOF);
  read_reals(f->payload + 32, change, DBK_MAX_DOF);
  for (int32_t k = 0; k < robot_model.n; ++k) {
    const dbk_real most = (dbk_real)1.001 * robot_model.v_max[k];
    if (!(u[k] >= -most && u[k] <= most && change[k] >= -(dbk_real)2 * most && change[k] <= (dbk_real)2 * most)) {
      return 0;
    }
  }
  for (int32_t k = 0; k < robot_model.n; ++k) {
    e->reset_u[k] = u[k];
    e->reset_change[k] = change[k];
  }
  e->reset_waits = 1;
  return 1;
}

/* 1 if joint `k` may continue from `u`; a measured velocity of NaN does not count */
static int may_continue_from(const executive *e, int32_t k, dbk_real u, int slowing) {
  const dbk_real last = e->cycle.ctx.u_prev[k], v = e->cycle.in.v[k];
  const dbk_real low = v < last ? v : last, high = v > last ? v : last;
  const dbk_real change = (dbk_real)RESET_PERIODS * robot_model.a_max[k] * robot_model.period;
  const dbk_real fastest = -low > high ? -low : high;
  return u >= low - change && u <= high + change && !(slowing && (u > fastest || u < -fastest));
}

int reset_apply(executive *e) {
  const int slowing = e->cycle.supervisor.decision.action >= DBK_ACTION_HOVER && !e->cycle.yielding;
  if (!e->reset_waits) { return 1; }
  e->reset_waits = 0;
  for (int32_t k = 0; k < robot_model.n; ++k) {
    if (!may_continue_from(e, k, e->reset_u[k], slowing)) { return 0; }
  }
  dbk_init(&e->cycle.ctx);
  for (int32_t k = 0; k < robot_model.n; ++k) {
    e->cycle.ctx.u_prev[k] = e->cycle.ctx.u_nom_prev[k] = e->reset_u[k];
    e->cycle.ctx.u_change[k] = e->reset_change[k];
  }
  return 1;
}

int scene_message_apply(executive *e, const frame *f) {
  uint32_t part = OBSTACLES_MISSING;
  int accepted = 0;
  switch (f->type) {
    case MESSAGE_SCENE_BEGIN: accepted = begin(e, f); break;
    case MESSAGE_OBSTACLES: accepted = add_obstacles(e, f); break;
    case MESSAGE_SCENE_END: accepted = end(e, f); break;
    case MESSAGE_PERMITS: return set_permits(e, f);
    case MESSAGE_HELD:
      part = HELD_MISSING;
      accepted = set_held(e, f);
      break;
    case MESSAGE_ROWS:
      part = ROWS_MISSING;
      accepted = set_rows(e, f);
      break;
    case MESSAGE_RESET: return keep_reset(e, f);
    default: return 0;
  }
  if (!accepted) {
    if (part == OBSTACLES_MISSING) { e->transferring = 0; }
    set_missing(e, part);
  }
  return accepted;
}
