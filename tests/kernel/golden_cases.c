/* The cases behind the golden hashes; see golden_cases.h. */
#include "golden_cases.h"

#include "arm.h"
#include "dynamics/dbk_contact_force.h"
#include "dynamics/dbk_inverse_dynamics.h"
#include "model/dbk_kinematics.h"
#include "qp/dbk_qp.h"

static dbk_model model;
static dbk_scene scene;
static dbk_ctx ctx;
static dbk_in in;
static dbk_out out;
static dbk_rows rows;

/* --- hashing ------------------------------------------------------------------------------------------------------ */

static void mix(golden_result *g, const void *data, size_t size) {
  const unsigned char *byte = data;
  for (size_t i = 0; i < size; ++i) { g->hash = (g->hash ^ byte[i]) * 1099511628211u; }
}

static void mix_real(golden_result *g, dbk_real value) { mix(g, &value, sizeof value); }

static void mix_int(golden_result *g, int32_t value) { mix(g, &value, sizeof value); }

/* field by field, because the padding of the structure is undefined */
static void mix_out(golden_result *g) {
  mix(g, out.u, sizeof out.u);
  mix_real(g, out.delta);
  mix_real(g, out.delta_rows);
  mix_real(g, out.delta_box);
  mix_real(g, out.h_min);
  mix_int(g, out.status);
  mix_int(g, out.flags);
  mix_int(g, out.certified);
  mix_int(g, out.iterations);
  mix_int(g, out.n_rows);
  mix_int(g, out.relaxed);
  mix_int(g, out.n_active);
  for (int a = 0; a < out.n_active; ++a) {
    mix_int(g, out.active[a].kind);
    mix_int(g, out.active[a].i);
    mix_int(g, out.active[a].j);
    mix_real(g, out.active[a].h);
    mix_real(g, out.active[a].multiplier);
  }
}

/* --- steps and loops ---------------------------------------------------------------------------------------------- */

static void step(golden_result *g) {
  dbk_step(&model, &scene, &ctx, &in, &out);
  mix_out(g);
  ++g->count[out.status];
  g->flags |= (uint32_t)out.flags;
  g->relaxed |= (uint32_t)out.relaxed;
  g->iterations = out.iterations > g->iterations ? out.iterations : g->iterations;
  g->rows = out.n_rows > g->rows ? out.n_rows : g->rows;
  g->active = out.n_active > g->active ? out.n_active : g->active;
}

static void project(golden_result *g, const dbk_real *u_prev, dbk_real extra) {
  dbk_real u[DBK_MAX_DOF] = {0};
  mix_int(g, (int32_t)dbk_project(&model, &scene, &ctx, &in, u_prev, extra, u));
  mix(g, u, sizeof u);
}

/* the arm at rest in its home posture, without obstacles */
static void start(void) {
  static const double home[7] = {0, -0.3, 0, -2.2, 0, 2.0, 0.785};
  arm_model(&model);
  dbk_scene_clear(&scene);
  dbk_scene_prepare(&scene);
  dbk_init(&ctx);
  memset(&in, 0, sizeof in);
  for (int k = 0; k < 7; ++k) { in.q[k] = (dbk_real)home[k]; }
  in.opening = (dbk_real)0.02;
}

/* the plant follows with a lag of 20 periods; the nominal control is random and changes every `hold` steps */
static void loop(golden_result *g, uint64_t *state, int steps, int hold) {
  for (int t = 0; t < steps; ++t) {
    if (t % hold == 0) {
      for (int k = 0; k < model.n; ++k) { in.u_nom[k] = random_between(state, -2.2, 2.2); }
    }
    in.scene_age = scene.moving ? (dbk_real)(0.0002 * (t % 2000)) : (dbk_real)0;
    step(g);
    for (int k = 0; k < model.n; ++k) {
      in.v[k] = in.v[k] + (out.u[k] - in.v[k]) * (dbk_real)0.05;
      in.q[k] += model.period * in.v[k];
    }
  }
}

static void tool(dbk_real p[3]) {
  dbk_frames f;
  dbk_base_frame(&in, &f);
  dbk_fk(&model, in.q, &f);
  const dbk_real *r = f.rotation[model.n], *o = f.origin[model.n], *t = model.tool_offset;
  for (int e = 0; e < 3; ++e) { p[e] = o[e] + (r[3 * e] * t[0] + r[3 * e + 1] * t[1] + r[3 * e + 2] * t[2]); }
}

/* adds a static sphere, which the caller can modify */
static dbk_obstacle *add_sphere(double x, double y, double z, double radius) {
  dbk_obstacle *o = &scene.obstacle[scene.n_obstacles++];
  memset(o, 0, sizeof *o);
  o->shape = DBK_CAPSULE;
  o->flags = DBK_STATIC;
  o->rank = DBK_RANK_OBSTACLE;
  o->link_mask = ~0u;
  o->rotation[0] = o->rotation[4] = o->rotation[8] = 1;
  o->position[0] = (dbk_real)x;
  o->position[1] = (dbk_real)y;
  o->position[2] = (dbk_real)z;
  o->radius = (dbk_real)radius;
  return o;
}

/* adds a static sphere at a position relative to the tool */
static dbk_obstacle *near_tool(double x, double y, double z, double radius) {
  dbk_real p[3];
  tool(p);
  return add_sphere((double)p[0] + x, (double)p[1] + y, (double)p[2] + z, radius);
}

/* a random rotation from a quaternion, normalised by Newton iterations because libm is not available */
static void rotate(dbk_obstacle *o, uint64_t *state) {
  double w = 0.6 + 0.3 * random_uniform(state), x = random_uniform(state) - 0.5, y = random_uniform(state) - 0.5,
         z = random_uniform(state) - 0.5;
  const double square = w * w + x * x + y * y + z * z;
  double scale = 1.0;
  for (int i = 0; i < 30; ++i) { scale = scale * (1.5 - 0.5 * square * scale * scale); }
  w *= scale;
  x *= scale;
  y *= scale;
  z *= scale;
  const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                       2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                       2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  for (int e = 0; e < 9; ++e) { o->rotation[e] = (dbk_real)r[e]; }
}

static void hold_two_spheres(void) {
  scene.n_held = 2;
  for (int s = 0; s < 2; ++s) {
    scene.held_x[s] = scene.held_y[s] = 0;
    scene.held_z[s] = (dbk_real)(0.24 + 0.03 * s);
    scene.held_r[s] = (dbk_real)0.03;
  }
  scene.held_error = (dbk_real)0.002;
}

/* --- cases -------------------------------------------------------------------------------------------------------- */

/* random scenes: all shapes with random rotations, static and moving, with and without a held object */
static void scenes(golden_result *g) {
  for (uint64_t run = 0; run < 6; ++run) {
    uint64_t state = run * 7919 + 1;
    start();
    arm_scene(&scene, &state, 8);
    for (int o = 1; o < scene.n_obstacles; ++o) { rotate(&scene.obstacle[o], &state); }
    if (run % 2) { hold_two_spheres(); }
    dbk_scene_prepare(&scene);
    loop(g, &state, 600, 100);
  }
}

/* static obstacles, some with their own gain */
static void still_things(golden_result *g) {
  for (uint64_t run = 0; run < 3; ++run) {
    uint64_t state = run + 50;
    start();
    arm_scene(&scene, &state, 14);
    for (int o = 0; o < scene.n_obstacles; ++o) {
      scene.obstacle[o].flags = DBK_STATIC;
      for (int e = 0; e < 3; ++e) { scene.obstacle[o].velocity[e] = 0; }
      scene.obstacle[o].velocity_error = 0;
      if (o % 4 == 3) { scene.obstacle[o].alpha = (dbk_real)1.5; }
    }
    dbk_scene_prepare(&scene);
    loop(g, &state, 800, 150);
  }
}

/* self-collision only, without and with a held object */
static void own_parts(golden_result *g) {
  uint64_t state = 7;
  start();
  for (int run = 0; run < 4; ++run) {
    if (run == 2) {
      hold_two_spheres();
      dbk_scene_prepare(&scene);
    }
    loop(g, &state, 700, 350);
  }
}

/* the tool moves into an obstacle that some of its links are permitted to touch */
static void permits(golden_result *g) {
  uint64_t state = 3;
  start();
  near_tool(0.0, 0.0, -0.05, 0.04);
  near_tool(0.1, 0.0, 0.0, 0.05)->shape = DBK_BOX;
  scene.obstacle[1].half[0] = scene.obstacle[1].half[1] = scene.obstacle[1].half[2] = (dbk_real)0.03;
  for (int l = 5; l < 8; ++l) { scene.permit[l][0] = (dbk_real)0.05; }
  scene.permit[7][1] = (dbk_real)0.02;
  scene.permit[8][0] = (dbk_real)0.1;
  hold_two_spheres();
  scene.obstacle[0].link_mask = ~(1u << 4);
  dbk_scene_prepare(&scene);
  loop(g, &state, 1200, 120);
}

/* the arm starts in penetration: on the axis of a capsule, at the centre of a box, inside a half-space */
static void recovery(golden_result *g) {
  for (int shape = 0; shape < 3; ++shape) {
    uint64_t state = (uint64_t)shape;
    dbk_sphere_set spheres;
    dbk_frames f;
    start();
    dbk_base_frame(&in, &f);
    dbk_fk(&model, in.q, &f);
    dbk_spheres(&model, &scene, &f, in.opening, &spheres);
    dbk_obstacle *o = add_sphere((double)spheres.x[8], (double)spheres.y[8], (double)spheres.z[8], 0.03);
    o->shape = shape;
    o->half[0] = (dbk_real)0.02;
    o->half[1] = (dbk_real)0.04;
    o->half[2] = (dbk_real)0.03;
    if (shape == DBK_HALF_SPACE) { o->position[2] += (dbk_real)0.05; }
    dbk_scene_prepare(&scene);
    for (int t = 0; t < 300; ++t) {
      step(g);
      for (int k = 0; k < model.n; ++k) { in.q[k] += model.period * out.u[k]; }
    }
    loop(g, &state, 200, 50);
  }
}

/* the joints move into their limits, or start beyond them */
static void joint_limits(golden_result *g) {
  for (int side = -1; side <= 1; side += 2) {
    start();
    for (int k = 0; k < model.n; ++k) {
      in.q[k] =
          side < 0 ? model.q_lower[k] + (dbk_real)(0.05 * (k - 2)) : model.q_upper[k] - (dbk_real)(0.05 * (k - 2));
      ctx.u_prev[k] = (dbk_real)side * (dbk_real)0.9 * model.v_max[k];
      in.u_nom[k] = (dbk_real)side * model.v_max[k];
    }
    for (int t = 0; t < 400; ++t) {
      step(g);
      for (int k = 0; k < model.n; ++k) { in.q[k] += model.period * out.u[k]; }
    }
  }
}

/* two obstacles approach from opposite sides: no control satisfies both rows */
static void closing_in(golden_result *g) {
  for (int run = 0; run < 4; ++run) {
    uint64_t state = (uint64_t)run + 20;
    start();
    for (int side = -1; side <= 1; side += 2) {
      dbk_obstacle *o = near_tool(0.0, 0.16 * side, 0.0, 0.05);
      o->flags = run % 2 ? DBK_KNOWN : 0;
      o->velocity[1] = (dbk_real)(-0.5 * side);
      o->rank = side < 0 || run < 2 ? DBK_RANK_BODY : DBK_RANK_TASK;
    }
    dbk_obstacle *floor_below = near_tool(0.0, 0.0, -0.12, 0.0);
    floor_below->shape = DBK_HALF_SPACE;
    floor_below->rank = DBK_RANK_WORKSPACE;
    dbk_scene_prepare(&scene);
    for (int k = 0; k < model.n; ++k) { ctx.u_prev[k] = (dbk_real)(0.2 * (k % 2 ? 1 : -1)); }
    loop(g, &state, 300, 60);
    project(g, ctx.u_prev, (dbk_real)5e-4);
  }
}

/* an obstacle appears directly ahead at full speed: neither braking nor the certificate can prevent contact; in the last
 * six runs the parts are also faster than their limit */
static void too_late(golden_result *g) {
  for (int run = 0; run < 12; ++run) {
    start();
    model.speed_limit = (dbk_real)(run < 6 ? 0.0 : 0.3);
    dbk_prepare(&model);
    for (int k = 0; k < model.n; ++k) {
      ctx.u_prev[k] = in.v[k] = (dbk_real)0.8 * model.v_max[k] * (k % 2 ? 1 : (run % 2 ? 1 : -1));
      in.u_nom[k] = ctx.u_prev[k];
    }
    for (int t = 0; t < 60; ++t) {
      if (t == (run < 6 ? 10 : 1)) {
        const double y = 0.02 * (run % 6 - 3), z = -0.04 - 0.01 * (run % 6);
        near_tool(0.0, y, z, run < 6 ? 0.03 : 0.06)->flags = run % 3 ? DBK_STATIC : 0;
        dbk_scene_prepare(&scene);
      }
      step(g);
      for (int k = 0; k < model.n; ++k) {
        in.q[k] += model.period * out.u[k];
        in.v[k] = out.u[k];
      }
    }
  }
}

/* the linearisation of the rows is inaccurate: with a large alpha and a long period the certificate fails */
static void uncertain(golden_result *g) {
  for (int run = 0; run < 3; ++run) {
    uint64_t state = (uint64_t)run + 30;
    start();
    model.period = (dbk_real)0.01;
    model.alpha = model.alpha_self = (dbk_real)(20.0 + 30.0 * run);
    model.lag = 0;
    for (int k = 0; k < model.n; ++k) { model.a_max[k] *= run == 2 ? (dbk_real)30 : (dbk_real)2; }
    dbk_prepare(&model);
    for (int o = 0; o < 10; ++o) {
      const double x = random_uniform(&state) < 0.5 ? -0.13 : 0.13, y = 0.4 * random_uniform(&state) - 0.2;
      near_tool(x, y, 0.4 * random_uniform(&state) - 0.3, 0.03);
    }
    dbk_scene_prepare(&scene);
    loop(g, &state, 300, 20);
  }
}

/* all reasons for which the filter rejects its input */
static void refusals(golden_result *g) {
  const dbk_real none = (dbk_real)1e30 * (dbk_real)1e30, nan = none - none;
  for (int what = 0; what < 20; ++what) {
    start();
    dbk_obstacle *o = add_sphere(0.5, 0.4, 0.3, 0.05);
    for (int k = 0; k < model.n; ++k) { ctx.u_prev[k] = (dbk_real)(0.1 * (k - 3)); }
    if (what == 0) { in.q[2] = nan; }
    if (what == 1) { in.v[5] = none; }
    if (what == 2) { in.u_nom[6] = nan; }
    if (what == 3) { in.opening = (dbk_real)0.3; }
    if (what == 4) { in.state_age = (dbk_real)0.2; }
    if (what == 5) { in.state_age = (dbk_real)-0.1; }
    if (what == 6) { in.scene_age = nan; }
    if (what == 7) {
      o->flags = 0;
      in.scene_age = (dbk_real)0.7;
    }
    if (what == 8) { in.q[1] = (dbk_real)3; }
    if (what == 9) {
      in.mobile = 1;
      in.base_rotation[3] = nan;
    }
    if (what == 10) { o->position[1] = none; }
    if (what == 11) { o->shape = 9; }
    if (what == 12) { o->radius = (dbk_real)-1; }
    if (what == 13) { scene.n_held = 99; }
    if (what == 14) {
      scene.n_held = 1;
      scene.held_r[0] = nan;
    }
    if (what == 15) { o->alpha = (dbk_real)-1; }
    if (what == 16) { o->brake = none; }
    if (what == 17) { o->rank = 0; }
    if (what == 18) {
      scene.n_user = 1;
      scene.user_rank[0] = DBK_RANK_TASK;
      scene.user_a[0][0] = nan;
    }
    if (what == 19) { in.u_nom[0] = (dbk_real)1e20; }
    dbk_scene_prepare(&scene);
    step(g);
    step(g);
    project(g, ctx.u_prev, (dbk_real)5e-4);
    scene.n_user = scene.n_held = 0;
  }
}

/* links that no joint can move away: in penetration, and with an approaching obstacle */
static void no_way_out(golden_result *g) {
  for (int run = 0; run < 4; ++run) {
    start();
    dbk_obstacle *o = add_sphere(0.0, 0.0, run % 2 ? 0.333 : 0.9, 0.3);
    o->flags = run < 2 ? 0 : DBK_STATIC;
    o->velocity[2] = run < 2 ? (dbk_real)-0.5 : 0;
    if (run == 3) {
      model.n_pairs = 0;
      for (int s = 0; s < model.n_spheres; ++s) { model.x[s] = model.y[s] = model.z[s] = 0; }
      for (int k = 0; k < model.n; ++k) {
        for (int e = 0; e < 2; ++e) { model.joint_offset[k][e] = 0; }
        if (k) { model.joint_offset[k][2] = 0; }
      }
      dbk_prepare(&model);
    }
    dbk_scene_prepare(&scene);
    for (int t = 0; t < 20; ++t) {
      for (int k = 0; k < model.n; ++k) { in.u_nom[k] = (dbk_real)0.01; }
      step(g);
      project(g, ctx.u_prev, 0);
    }
  }
}

/* many spheres on the last frame, on one link or on thirteen links */
static void many_spheres(int32_t n_links) {
  uint64_t state = 77;
  model.n_spheres = DBK_MAX_SPHERES;
  model.n_links = n_links;
  for (int s = 12; s < DBK_MAX_SPHERES; ++s) {
    model.x[s] = random_between(&state, -0.05, 0.05);
    model.y[s] = random_between(&state, -0.05, 0.05);
    model.z[s] = random_between(&state, 0.0, 0.2);
    model.radius[s] = (dbk_real)0.02;
  }
  for (int l = 7; l < n_links; ++l) {
    model.link_frame[l] = 7;
    model.link_first[l + 1] = l == n_links - 1 ? DBK_MAX_SPHERES : 12 + (l - 6) * 7;
  }
}

/* overflow of the row buffer, with user rows, and of the list for the certificate */
static void overflow(golden_result *g) {
  for (int run = 0; run < 2; ++run) {
    uint64_t state = 78;
    start();
    many_spheres(run ? DBK_MAX_LINKS : 8);
    if (run) { /* overlapping links */
      for (int s = model.link_first[1]; s < model.link_first[7]; ++s) { model.radius[s] = (dbk_real)0.6; }
      for (int l = 8; l < DBK_MAX_LINKS; ++l) {
        for (int near = 1; near < 7; ++near) {
          model.pair[model.n_pairs][0] = near;
          model.pair[model.n_pairs++][1] = l;
        }
      }
      hold_two_spheres();
    }
    dbk_prepare(&model);
    for (int o = 0; o < DBK_MAX_OBSTACLES; ++o) {
      const double x = 0.2 * random_uniform(&state) - 0.1, y = 0.2 * random_uniform(&state) - 0.1;
      near_tool(x, y, 0.2 * random_uniform(&state) - 0.1, run ? 1.5 : 0.15 - 0.002 * o);
      for (int l = 0; run && l < DBK_ALL_LINKS; ++l) { scene.permit[l][o] = (dbk_real)(-1 - l % 2); } /* none, twice */
    }
    scene.n_user = 2;
    for (int r = 0; r < 2; ++r) {
      scene.user_rank[r] = DBK_RANK_TASK;
      for (int k = 0; k < model.n; ++k) { scene.user_a[r][k] = (dbk_real)(k == r); }
      scene.user_b[r] = (dbk_real)-0.5;
    }
    dbk_scene_prepare(&scene);
    for (int t = 0; t < 3; ++t) {
      step(g);
      project(g, ctx.u_prev, (dbk_real)1e-3);
    }
  }
  scene.n_user = 0;
}

/* the projection: known obstacles only, extra clearance, its own u_prev */
static void projection(golden_result *g) {
  uint64_t state = 9;
  dbk_real u_prev[DBK_MAX_DOF] = {0};
  start();
  arm_scene(&scene, &state, 10);
  for (int t = 0; t < 1000; ++t) {
    if (t % 100 == 0) {
      for (int k = 0; k < model.n; ++k) { in.u_nom[k] = random_between(&state, -2.2, 2.2); }
    }
    dbk_real u[DBK_MAX_DOF] = {0};
    mix_int(g, (int32_t)dbk_project(&model, &scene, &ctx, &in, u_prev, (dbk_real)5e-4, u));
    mix(g, u, sizeof u);
    memcpy(u_prev, u, sizeof u);
    for (int k = 0; k < model.n; ++k) { in.q[k] += model.period * u[k]; }
  }
}

/* wide control bounds: the trust region around the expected solution, then around the last result, then the full
 * bounds; afterwards the omitted rows are added */
static void wide_box(golden_result *g) {
  for (uint64_t run = 0; run < 3; ++run) {
    uint64_t state = run + 900;
    dbk_real u_prev[DBK_MAX_DOF] = {0};
    start();
    for (int k = 0; k < model.n; ++k) { model.a_max[k] = run == 2 ? (dbk_real)200 : (dbk_real)1e4; }
    for (int o = 0; o < 12; ++o) {
      const double x = 0.6 * random_uniform(&state) - 0.3, y = 0.6 * random_uniform(&state) - 0.3;
      near_tool(x, y, 0.15 + 0.2 * random_uniform(&state), 0.03)->flags |= DBK_KNOWN;
    }
    dbk_scene_prepare(&scene);
    for (int t = 0; t < 300; ++t) {
      if (t % 40 == 0) {
        for (int k = 0; k < model.n; ++k) { in.u_nom[k] = random_between(&state, -2.2, 2.2); }
      }
      project(g, u_prev, (dbk_real)5e-4);
      step(g);
      memcpy(u_prev, out.u, sizeof u_prev);
      if (t % 7 == 0) {
        dbk_all_rows(&model, &scene, &ctx, &in);
        mix_int(g, ctx.rows.count);
      }
      for (int k = 0; k < model.n; ++k) { in.q[k] += model.period * out.u[k]; }
    }
  }
}

/* user rows: satisfied, active, conflicting, and with a zero normal */
static void user_rows(golden_result *g) {
  for (int run = 0; run < 4; ++run) {
    uint64_t state = (uint64_t)run + 60;
    start();
    if (run == 1) { arm_scene(&scene, &state, 8); }
    scene.n_user = 6;
    for (int r = 0; r < scene.n_user; ++r) {
      scene.user_rank[r] = DBK_RANK_BODY + r % 4;
      scene.user_b[r] = random_between(&state, -0.3, run == 2 ? 0.4 : -0.02);
      scene.user_h[r] = random_between(&state, 0.0, 0.2);
      for (int k = 0; k < model.n; ++k) {
        scene.user_a[r][k] = run == 3 && r < 2 ? 0 : random_between(&state, -1.0, 1.0);
      }
    }
    if (run == 3) { scene.user_b[1] = (dbk_real)0.1; }
    dbk_scene_prepare(&scene);
    loop(g, &state, 400, 80);
  }
  scene.n_user = 0;
}

/* speed and separation monitoring: static and moving persons, and a person too close from the start */
static void separation(golden_result *g) {
  for (int run = 0; run < 4; ++run) {
    uint64_t state = (uint64_t)run + 90;
    start();
    dbk_obstacle *o = near_tool(run == 3 ? 0.06 : 0.3, 0.05, 0.0, 0.05);
    o->flags = run == 1 ? DBK_STATIC : 0;
    o->rank = DBK_RANK_BODY;
    o->reaction = (dbk_real)0.1;
    o->brake = (dbk_real)(run == 2 ? 0.5 : 3.0);
    o->approach = (dbk_real)(run == 0 ? 0.0 : 0.4);
    o->velocity[0] = (dbk_real)(run == 1 ? 0.0 : -0.15);
    o->velocity_error = (dbk_real)(run == 1 ? 0.0 : 0.02);
    dbk_scene_prepare(&scene);
    loop(g, &state, 500, 100);
  }
}

/* the jerk limit: alone, with obstacles, and overridden by another limit */
static void jerk(golden_result *g) {
  for (int run = 0; run < 3; ++run) {
    uint64_t state = (uint64_t)run + 120;
    start();
    for (int k = 0; k < model.n; ++k) { model.j_max[k] = k == 4 ? 0 : (dbk_real)(run == 1 ? 200.0 : 3000.0); }
    if (run) {
      arm_scene(&scene, &state, 8);
      dbk_scene_prepare(&scene);
    }
    if (run == 2) {
      for (int k = 0; k < model.n; ++k) {
        ctx.u_change[k] = (dbk_real)0.01;
        ctx.u_prev[k] = model.v_max[k];
      }
    }
    loop(g, &state, 600, 70);
  }
}

/* the jerk limit at the position limits: approaches at full speed, states that leave room only for a stop, states that
 * leave no room, and braking after a rejected input */
static void jerk_at_limits(golden_result *g) {
  for (int run = 0; run < 8; ++run) {
    uint64_t state = (uint64_t)run + 220;
    start();
    for (int k = 0; k < model.n; ++k) {
      const dbk_real toward = run % 2 ? (dbk_real)1 : (dbk_real)-1;
      const dbk_real limit = run % 2 ? model.q_upper[k] : model.q_lower[k];
      model.j_max[k] = (dbk_real)(run < 2 ? 3000.0 : run < 4 ? 60.0 : 800.0);
      in.q[k] = limit - toward * (dbk_real)(run < 4 ? 0.4 : run < 6 ? 0.12 : 0.01);
      in.u_nom[k] = toward * model.v_max[k];
      if (run >= 4) { ctx.u_prev[k] = toward * (dbk_real)(run < 6 ? 0.8 : 1.0); }
      if (run >= 6) { ctx.u_change[k] = toward * (dbk_real)0.01; }
    }
    for (int t = 0; t < 700; ++t) {
      if (t == 350 || t == 351) { in.u_nom[0] = DBK_NAN; }
      step(g);
      for (int k = 0; k < model.n; ++k) {
        in.q[k] += model.period * out.u[k];
        if (t % 200 == 199) { in.u_nom[k] = random_between(&state, -2.2, 2.2); }
      }
      if (t == 352) { in.u_nom[0] = (dbk_real)1; }
    }
  }
}

/* the floor touches the first link, which turns above it: the distance changes only by rounding */
static void mount(golden_result *g) {
  for (int run = 0; run < 2; ++run) {
    uint64_t state = (uint64_t)run + 240;
    start();
    step(g);
    dbk_real lowest = DBK_MAX_DISTANCE;
    for (int s = 0; s < model.n_spheres; ++s) {
      const dbk_real bottom = ctx.spheres.z[s] - ctx.spheres.r[s];
      if (model.sphere_frame[s] == 1 && bottom < lowest) { lowest = bottom; }
    }
    dbk_obstacle *floor = add_sphere(0, 0, (double)lowest, 0);
    floor->shape = DBK_HALF_SPACE;
    floor->flags = run ? 0 : DBK_STATIC;
    dbk_scene_prepare(&scene);
    loop(g, &state, 400, 80);
  }
}

/* prismatic joints: a gantry of three joints below the last four joints of the arm */
static void sliding(golden_result *g) {
  for (int run = 0; run < 2; ++run) {
    uint64_t state = (uint64_t)run + 150;
    start();
    for (int k = 0; k < 3; ++k) {
      model.joint_kind[k] = DBK_PRISMATIC;
      model.q_lower[k] = (dbk_real)-0.5;
      model.q_upper[k] = (dbk_real)0.5;
      in.q[k] = 0;
    }
    dbk_prepare(&model);
    arm_scene(&scene, &state, 10);
    if (run) { hold_two_spheres(); }
    dbk_scene_prepare(&scene);
    loop(g, &state, 600, 90);
  }
}

/* a mobile base that changes its position and heading during the motion, at last by its own drive and turn */
static void mobile_base(golden_result *g) {
  uint64_t state = 180;
  start();
  arm_scene(&scene, &state, 8);
  in.mobile = 1;
  in.base_rotation[8] = 1;
  for (int piece = 0; piece < 4; ++piece) {
    const dbk_real s = (dbk_real)(0.2 * piece);
    dbk_real sine, cosine;
    dbk_sincos(s, &sine, &cosine);
    in.base_rotation[0] = in.base_rotation[4] = cosine;
    in.base_rotation[3] = sine;
    in.base_rotation[1] = -sine;
    in.base_position[0] = (dbk_real)(0.05 * piece);
    in.base_position[2] = (dbk_real)0.1;
    if (piece == 2) {
      model.moving_base = 1;
      model.joint_kind[0] = DBK_PRISMATIC;
      in.q[0] = 0;
      dbk_prepare(&model);
      dbk_scene_prepare(&scene);
    }
    loop(g, &state, 250, 60);
  }
}

/* speed limits: alone, with obstacles, an object in the hand, jerk limits, sliding joints, and a person who comes nearer;
 * a state that is too fast, the projection, and control bounds so wide that the cuts do not suffice */
static void speed_limits(golden_result *g) {
  for (int run = 0; run < 13; ++run) {
    uint64_t state = (uint64_t)run + 300;
    start();
    model.speed_limit = (dbk_real)(run == 11 ? 0.0 : run == 12 ? 0.03 : run % 3 == 2 ? 0.05 : 0.3);
    model.lag = (dbk_real)(run == 2 ? 0.02 : 0.0);
    model.speed_first_joint = run == 5 ? 2 : 0;
    for (int k = 0; k < model.n; ++k) {
      if (run == 12) { model.a_max[k] = (dbk_real)1e4; }
      model.j_max[k] = (dbk_real)(run == 3 || run == 4 ? 4000.0 : 0.0);
      if (run == 6 && k < 3) {
        model.joint_kind[k] = DBK_PRISMATIC;
        model.q_lower[k] = (dbk_real)-0.5;
        model.q_upper[k] = (dbk_real)0.5;
        in.q[k] = 0;
      }
      if (run >= 7 && run <= 8) { ctx.u_prev[k] = (dbk_real)(run == 7 ? 1.2 : 0.3) * (dbk_real)(k % 2 ? -1 : 1); }
    }
    dbk_prepare(&model);
    if (run % 2 || run == 6) { arm_scene(&scene, &state, 6); }
    if (run == 4 || run == 8) { hold_two_spheres(); }
    if (run >= 8 && run < 12) {
      dbk_obstacle *o = near_tool(0.7, 0.1, 0.0, 0.1);
      o->flags = run == 10 ? DBK_KNOWN : 0;
      o->rank = DBK_RANK_BODY;
      o->velocity[0] = (dbk_real)(run == 11 ? -1.5 : -0.6);
      o->near_speed = (dbk_real)0.15;
      o->near_distance = (dbk_real)0.2;
      o->near_brake = (dbk_real)1.0;
      o->near_approach = (dbk_real)0.1;
      if (run == 9) { o->link_mask = 1u << 6; }
    }
    dbk_scene_prepare(&scene);
    for (int piece = 0; piece < 4; ++piece) {
      loop(g, &state, 150, 75);
      project(g, ctx.u_prev, (dbk_real)5e-4);
      if (run == 8 && piece == 1) {
        scene.n_held = 0;
        dbk_scene_prepare(&scene);
      }
    }
  }
}

/* single functions: sine and cosine, and the Jacobian */
static void parts(golden_result *g) {
  uint64_t state = 200;
  start();
  for (int t = 0; t < 2000; ++t) {
    dbk_real s, c;
    dbk_sincos(t ? random_between(&state, -9.0, 9.0) : (dbk_real)1e9, &s, &c);
    mix_real(g, s);
    mix_real(g, c);
  }
  for (int t = 0; t < 50; ++t) {
    dbk_frames f;
    dbk_real p[3], linear[3][DBK_MAX_DOF] = {{0}}, angular[3][DBK_MAX_DOF] = {{0}};
    for (int k = 0; k < model.n; ++k) {
      in.q[k] = random_between(&state, (double)model.q_lower[k], (double)model.q_upper[k]);
      model.joint_kind[k] = t % 2 && k < 2 ? DBK_PRISMATIC : DBK_REVOLUTE;
    }
    tool(p);
    dbk_base_frame(&in, &f);
    dbk_fk(&model, in.q, &f);
    dbk_jacobian(&model, &f, p, linear, angular);
    mix(g, p, sizeof p);
    mix(g, linear, sizeof linear);
    mix(g, angular, sizeof angular);
  }
}

/* the QP with generic, nearly parallel and infeasible rows */
static void programs(golden_result *g) {
  const dbk_model *const arm = &model;
  uint64_t state = 220;
  start();
  for (int t = 0; t < 600; ++t) {
    dbk_real lower[DBK_MAX_DOF], upper[DBK_MAX_DOF], u_nom[DBK_MAX_DOF];
    dbk_solution s;
    int32_t warm[3];
    rows.count = (int32_t)(random_uniform(&state) * 60);
    for (int r = 0; r < (rows.count + DBK_LANES - 1) / DBK_LANES * DBK_LANES; ++r) {
      for (int k = 0; k < 7; ++k) { rows.a[k][r] = r < rows.count ? random_between(&state, -0.6, 0.6) : 0; }
      rows.b[r] = r < rows.count ? random_between(&state, -1.5, t % 3 ? -0.1 : 0.5) : (dbk_real)-1e9;
      if (t % 4 == 0 && r % 3 == 1) {
        for (int k = 0; k < 7; ++k) { rows.a[k][r] = rows.a[k][r - 1] * (dbk_real)1.00001; }
      }
      rows.soft[r] = (dbk_real)(r % 2 ? 0.001 : 0.0);
    }
    for (int k = 0; k < 7; ++k) {
      lower[k] = random_between(&state, -1.0, -0.1);
      upper[k] = random_between(&state, 0.1, 1.0);
      u_nom[k] = random_between(&state, -2.0, 2.0);
    }
    for (int w = 0; w < 3; ++w) { warm[w] = (int32_t)(random_uniform(&state) * (13.9 + (double)rows.count)); }
    mix_int(g, dbk_qp(&rows, 7, arm->scale, lower, upper, u_nom, t % 5 == 0, 0, warm, t % 2 ? 3 : 0, &s));
    mix(g, s.u, 7 * sizeof s.u[0]);
    mix_int(g, s.iterations);
    mix_int(g, s.infeasible);
    mix_int(g, s.n_active);
    for (int a = 0; a < s.n_active; ++a) {
      mix_int(g, s.active[a]);
      mix_real(g, s.multiplier[a]);
    }
    g->iterations = s.iterations > g->iterations ? s.iterations : g->iterations;
    g->rows = rows.count > g->rows ? rows.count : g->rows;
  }
}

static void mix_wrench(golden_result *g, const dbk_contact_force *contact, int32_t n) {
  mix(g, contact->force, sizeof contact->force);
  for (int i = 0; i < 3; ++i) { mix(g, contact->map[i], (size_t)n * sizeof contact->map[0][0]); }
  mix_real(g, contact->unexplained);
}

/* torques and contact forces of an arm with six revolute joints and a prismatic one */
static void dynamics(golden_result *g) {
  dbk_dynamics arm;
  uint64_t state = 330;
  start();
  memset(&arm, 0, sizeof arm);
  arm.n = model.n;
  memcpy(arm.joint_rotation, model.joint_rotation, sizeof arm.joint_rotation);
  memcpy(arm.joint_offset, model.joint_offset, sizeof arm.joint_offset);
  arm.joint_kind[3] = DBK_PRISMATIC;
  for (int i = 0; i < arm.n; ++i) {
    arm.body[i].mass = random_between(&state, 0.5, 4.0);
    for (int e = 0; e < 3; ++e) { arm.body[i].centre[e] = random_between(&state, -0.1, 0.1); }
    for (int e = 0; e < 6; ++e) { arm.body[i].inertia[e] = random_between(&state, 0.001, 0.02); }
    arm.rotor_inertia[i] = random_between(&state, 0.0, 0.2);
    arm.damping[i] = random_between(&state, 0.0, 1.0);
  }
  for (int t = 0; t < 200; ++t) {
    dbk_real q[DBK_MAX_DOF] = {0}, v[DBK_MAX_DOF] = {0}, a[DBK_MAX_DOF] = {0}, linear[3][DBK_MAX_DOF],
             angular[3][DBK_MAX_DOF], points[4][3];
    const int32_t joints[4] = {3, 4, 6, 7};
    dbk_frame_motion base = {{0}, {0}, {0, 0, (dbk_real)9.81}};
    dbk_arm_torque torque;
    dbk_contact_force contact;
    for (int i = 0; i < arm.n; ++i) {
      q[i] = random_between(&state, -2.0, 2.0);
      v[i] = random_between(&state, -1.0, 1.0);
      a[i] = random_between(&state, -5.0, 5.0);
      for (int e = 0; e < 3; ++e) {
        linear[e][i] = random_between(&state, -0.6, 0.6);
        angular[e][i] = random_between(&state, -1.0, 1.0);
      }
    }
    for (int i = 0; i < 12; ++i) { points[i / 3][i % 3] = random_between(&state, -0.5, 0.5); }
    base.spin[2] = random_between(&state, -1.0, 1.0);
    dbk_inverse_dynamics(&arm, &base, q, v, a, &torque);
    mix(g, torque.own, (size_t)arm.n * sizeof torque.own[0]);
    mix(g, torque.per_load, (size_t)arm.n * sizeof torque.per_load[0]);
    mix(g, torque.wrist, sizeof torque.wrist);
    mix(g, torque.wrist_per_load, sizeof torque.wrist_per_load);
    mix_int(g, dbk_locate_contact(arm.n, (const dbk_real(*)[DBK_MAX_DOF])linear, (const dbk_real(*)[DBK_MAX_DOF])angular,
                                  points[0], 4, (const dbk_real(*)[3])points, joints, torque.own, (dbk_real)0.0025,
                                  &contact));
    mix_wrench(g, &contact, arm.n);
  }
}

/* --- the table ---------------------------------------------------------------------------------------------------- */

static const struct {
  const char *name;
  void (*run)(golden_result *g);
} table[] = {
    {"scenes", scenes},
    {"still_things", still_things},
    {"own_parts", own_parts},
    {"permits", permits},
    {"recovery", recovery},
    {"joint_limits", joint_limits},
    {"closing_in", closing_in},
    {"too_late", too_late},
    {"uncertain", uncertain},
    {"refusals", refusals},
    {"no_way_out", no_way_out},
    {"overflow", overflow},
    {"projection", projection},
    {"user_rows", user_rows},
    {"separation", separation},
    {"wide_box", wide_box},
    {"jerk", jerk},
    {"jerk_at_limits", jerk_at_limits},
    {"mount", mount},
    {"sliding", sliding},
    {"mobile_base", mobile_base},
    {"speed_limits", speed_limits},
    {"parts", parts},
    {"programs", programs},
    {"dynamics", dynamics},
};

const int golden_count = sizeof table / sizeof table[0];

const char *golden_name(int index) { return table[index].name; }

void golden_run(int index, golden_result *result) {
  memset(result, 0, sizeof *result);
  result->hash = 1469598103934665603u;
  table[index].run(result);
}
