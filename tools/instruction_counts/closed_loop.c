/* A closed loop of the filter with an exported robot, for an emulated microcontroller and for the host. The caller calls
 * loop_begin once, then loop_propose, loop_step and loop_apply for every step, so that the instructions of loop_step are
 * those of dbk_step alone. The joints follow the control exactly; the nominal control changes every 150 steps between
 * the corners of the velocity limits. */
#include "dbk/dbk.h"
#include "distance/dbk_distance.h"
#include "model/dbk_kinematics.h"
#include "robot_table.h"

enum { STEPS_PER_CORNER = 150, PLACEMENT_TRIES = 20000 };
#define CLEARANCE 0.05f /* [m] between an obstacle and the arm in its home posture */

static dbk_scene scene;
static dbk_ctx ctx;
static dbk_in in;
static dbk_out out;
static uint64_t random_state;
static int32_t steps;

/* results of the steps, read by the caller */
uint64_t loop_hash;       /* FNV-1a over the bits of u, delta, h_min, flags, status and all rows of every step */
uint32_t loop_status[5];  /* number of steps by status */
int32_t loop_most_rows, loop_most_iterations;

static dbk_real chance(void) {
  uint64_t z = (random_state += 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return (dbk_real)((uint32_t)((z ^ (z >> 31)) >> 40)) * ((dbk_real)1 / (dbk_real)16777216);
}

static dbk_real between(dbk_real low, dbk_real high) { return low + (high - low) * chance(); }

/* an obstacle: try 0, 3, 6, ... is a sphere, 1, 4, 7, ... a capsule, 2, 5, 8, ... a box; every fifth one moves */
static dbk_obstacle random_obstacle(int32_t tries) {
  dbk_obstacle o = {.flags = DBK_KNOWN, .rank = DBK_RANK_OBSTACLE, .link_mask = 0xFFFFFFFFu, .margin = 0.005f};
  o.shape = tries % 3 == 2 ? DBK_BOX : DBK_CAPSULE;
  for (int32_t e = 0; e < 3; ++e) { o.position[e] = between(e < 2 ? -0.85f : 0.0f, e < 2 ? 0.85f : 1.0f); }
  for (int32_t e = 0; e < 9; e += 4) { o.rotation[e] = (dbk_real)1; }
  for (int32_t e = 0; e < 3; ++e) { o.half[e] = between(0.01f, 0.08f); }
  if (o.shape == DBK_CAPSULE) { o.radius = between(0.02f, 0.07f); }
  if (tries % 3 == 0) { o.half[2] = (dbk_real)0; }
  if (tries % 5 == 0) {
    o.velocity[0] = between(-0.1f, 0.1f);
    o.velocity_error = 0.02f;
  } else {
    o.flags |= DBK_STATIC;
  }
  return o;
}

static dbk_real clearance(const dbk_obstacle *o) {
  dbk_real least = (dbk_real)1;
  for (int32_t s = 0; s < robot_model.n_spheres; ++s) {
    dbk_real d, n[3];
    dbk_distance(o, 1, &ctx.spheres.x[s], &ctx.spheres.y[s], &ctx.spheres.z[s], &d, n, n + 1, n + 2);
    d -= ctx.spheres.r[s];
    least = d < least ? d : least;
  }
  return least;
}

static void place_obstacles(int32_t count) {
  int32_t n = 0;
  dbk_base_frame(&in, &ctx.frames);
  dbk_fk(&robot_model, in.q, &ctx.frames);
  dbk_spheres(&robot_model, &scene, &ctx.frames, in.opening, &ctx.spheres);
  for (int32_t tries = 0; n < count && n < DBK_MAX_OBSTACLES && tries < PLACEMENT_TRIES; ++tries) {
    const dbk_obstacle o = random_obstacle(tries);
    if (clearance(&o) > (dbk_real)CLEARANCE) { scene.obstacle[n++] = o; }
  }
  for (int32_t l = 0; l < DBK_ALL_LINKS; ++l) {
    for (int32_t o = 0; o < n; ++o) { scene.permit[l][o] = (dbk_real)-1; }
  }
  scene.n_obstacles = n;
}

/* loads the robot, and places `obstacles` obstacles at random; returns their number */
int32_t loop_begin(int32_t obstacles, uint32_t seed) {
  const dbk_in rest = {.opening = (dbk_real)0};
  random_state = seed;
  steps = loop_most_rows = loop_most_iterations = 0;
  loop_hash = 14695981039346656037u;
  for (int32_t s = 0; s < 5; ++s) { loop_status[s] = 0; }
  dbk_prepare(&robot_model);
  in = rest;
  for (int32_t k = 0; k < ROBOT_JOINTS; ++k) { in.q[k] = robot_home[k]; }
  dbk_scene_clear(&scene);
  place_obstacles(obstacles);
  dbk_scene_prepare(&scene);
  dbk_init(&ctx);
  return scene.n_obstacles;
}

void loop_propose(void) {
  for (int32_t k = 0; k < ROBOT_JOINTS; ++k) {
    if (steps % STEPS_PER_CORNER == 0) { in.u_nom[k] = chance() < 0.5f ? -robot_model.v_max[k] : robot_model.v_max[k]; }
    in.v[k] = ctx.u_prev[k];
  }
  ++steps;
}

int32_t loop_step(void) { return (int32_t)dbk_step(&robot_model, &scene, &ctx, &in, &out); }

static void mix(const void *at, uint32_t count) {
  const uint8_t *byte = at;
  for (uint32_t i = 0; i < count; ++i) { loop_hash = (loop_hash ^ byte[i]) * 1099511628211u; }
}

/* moves the joints, and adds the results of the step to the hash */
void loop_apply(void) {
  ++loop_status[out.status];
  loop_most_rows = out.n_rows > loop_most_rows ? out.n_rows : loop_most_rows;
  loop_most_iterations = out.iterations > loop_most_iterations ? out.iterations : loop_most_iterations;
  mix(out.u, (uint32_t)sizeof(dbk_real) * ROBOT_JOINTS);
  mix(&out.delta, (uint32_t)sizeof out.delta);
  mix(&out.h_min, (uint32_t)sizeof out.h_min);
  mix(&out.flags, (uint32_t)sizeof out.flags);
  mix(&out.status, (uint32_t)sizeof out.status);
  mix(&out.n_rows, (uint32_t)sizeof out.n_rows);
  mix(ctx.rows.b, (uint32_t)ctx.rows.count * (uint32_t)sizeof(dbk_real));
  for (int32_t k = 0; k < ROBOT_JOINTS; ++k) { in.q[k] += robot_model.period * out.u[k]; }
}
