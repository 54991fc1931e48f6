/* What is computed once: longest lever arms of a model, and the sanity of a scene. */
#include "dbk_math.h"

static dbk_real length(dbk_real x, dbk_real y, dbk_real z) { return dbk_sqrt(x * x + y * y + z * z); }

/* how far joint k can carry what lies beyond it from its own parent */
static dbk_real span(const dbk_model *model, int32_t k) {
  const dbk_real fixed = length(model->joint_offset[k][0], model->joint_offset[k][1], model->joint_offset[k][2]);
  if (model->joint_kind[k] != DBK_PRISMATIC) { return fixed; }
  return fixed + dbk_max(dbk_abs(model->q_lower[k]), dbk_abs(model->q_upper[k]));
}

/* reach[k][s]: no posture puts sphere s further from axis k than the sum of the offsets between them; a slide moves
 * everything at its own speed */
static dbk_real lever(const dbk_model *model, int32_t k, dbk_real arm) {
  return model->joint_kind[k] == DBK_PRISMATIC ? (dbk_real)1 : arm;
}

/* a ball around `count` spheres, and how near to its middle the nearest sphere comes; `shift` is how far the spheres may
 * move against the first one. A hundredth of a millimetre covers the rounding of what is computed with it. */
static dbk_ball ball_around(const dbk_real *x, const dbk_real *y, const dbk_real *z, const dbk_real *radius,
                            int32_t count, dbk_real shift) {
  dbk_ball ball = {(dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0};
  if (count <= 0) { return ball; }
  dbk_real lo[3] = {x[0], y[0], z[0]}, hi[3] = {x[0], y[0], z[0]};
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real c[3] = {x[s], y[s], z[s]};
    for (int32_t e = 0; e < 3; ++e) {
      lo[e] = dbk_min(lo[e], c[e]);
      hi[e] = dbk_max(hi[e], c[e]);
    }
  }
  const dbk_real cx = (dbk_real)0.5 * (lo[0] + hi[0]), cy = (dbk_real)0.5 * (lo[1] + hi[1]);
  const dbk_real cz = (dbk_real)0.5 * (lo[2] + hi[2]);
  const dbk_real slack = shift + DBK_CULL_FLOOR * (dbk_real)0.01;
  ball.inner = (dbk_real)1e3;
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real off = length(x[s] - cx, y[s] - cy, z[s] - cz);
    ball.radius = dbk_max(ball.radius, off + radius[s] + slack);
    ball.inner = dbk_min(ball.inner, off - radius[s] + slack);
  }
  ball.x = cx - x[0];
  ball.y = cy - y[0];
  ball.z = cz - z[0];
  return ball;
}

/* the balls around the links; fingers that open in different directions move against each other */
static void prepare_balls(dbk_model *model) {
  for (int32_t l = 0; l < model->n_links; ++l) {
    const int32_t first = model->link_first[l], last = model->link_first[l + 1];
    dbk_real shift = (dbk_real)0;
    for (int32_t s = first; s < last; ++s) {
      const dbk_real apart = length(model->slide_x[s] - model->slide_x[first], model->slide_y[s] - model->slide_y[first],
                                    model->slide_z[s] - model->slide_z[first]);
      shift = dbk_max(shift, (dbk_real)0.1 * apart); /* an opening is below 0.1 m */
    }
    model->ball[l] = ball_around(model->x + first, model->y + first, model->z + first, model->radius + first,
                                 last - first, shift);
  }
}

static void prepare_link_reach(dbk_model *model) {
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    for (int32_t l = 0; l <= model->n_links; ++l) {
      const int32_t held = l == model->n_links;
      const int32_t first = held ? model->n_spheres : model->link_first[l];
      const int32_t last = held ? model->n_spheres + DBK_MAX_HELD : model->link_first[l + 1];
      model->link_reach[k][l] = (dbk_real)0;
      for (int32_t s = first; s < last; ++s) {
        model->link_reach[k][l] = dbk_max(model->link_reach[k][l], model->reach[k][s]);
      }
    }
  }
}

void dbk_prepare(dbk_model *model) {
  for (int32_t l = 0; l < model->n_links; ++l) {
    const int32_t frame = model->link_frame[l];
    for (int32_t s = model->link_first[l]; s < model->link_first[l + 1]; ++s) {
      const dbk_real slide = (dbk_real)0.1 * length(model->slide_x[s], model->slide_y[s], model->slide_z[s]);
      model->sphere_frame[s] = frame;
      dbk_real arm = length(model->x[s], model->y[s], model->z[s]) + slide; /* an opening is below 0.1 m */
      for (int32_t k = DBK_MAX_DOF - 1; k >= 0; --k) {
        model->reach[k][s] = (dbk_real)0;
        if (k < frame) {
          model->reach[k][s] = lever(model, k, arm);
          arm += span(model, k);
        }
      }
    }
  }
  for (int32_t s = model->n_spheres; s < model->n_spheres + DBK_MAX_HELD; ++s) { model->sphere_frame[s] = model->n; }
  /* a held object: lever arms from the last frame; its own extent (up to 0.5 m from the tool) is added */
  dbk_real arm = (dbk_real)0.5 + length(model->tool_offset[0], model->tool_offset[1], model->tool_offset[2]);
  for (int32_t k = DBK_MAX_DOF - 1; k >= 0; --k) {
    for (int32_t s = model->n_spheres; s < model->n_spheres + DBK_MAX_HELD; ++s) {
      model->reach[k][s] = k < model->n ? lever(model, k, arm) : (dbk_real)0;
    }
    if (k < model->n) { arm += span(model, k); }
  }
  prepare_link_reach(model);
  prepare_balls(model);
}

void dbk_scene_clear(dbk_scene *scene) {
  scene->ready = 0;
  scene->moving = 0;
  scene->n_obstacles = 0;
  scene->n_held = 0;
  scene->n_user = 0;
  scene->held_error = (dbk_real)0;
  for (int32_t l = 0; l < DBK_ALL_LINKS; ++l) {
    for (int32_t o = 0; o < DBK_MAX_OBSTACLES; ++o) { scene->permit[l][o] = (dbk_real)-1; }
  }
}

static int32_t obstacle_good(const dbk_obstacle *o) {
  int32_t good = dbk_all_finite(o->position, 3) & dbk_all_finite(o->rotation, 9) & dbk_all_finite(o->half, 3);
  good &= dbk_all_finite(o->velocity, 3) & dbk_finite(o->radius) & dbk_finite(o->margin) & dbk_finite(o->velocity_error);
  good &= (o->shape >= DBK_CAPSULE && o->shape <= DBK_HALF_SPACE);
  good &= (o->radius >= (dbk_real)0 && o->velocity_error >= (dbk_real)0);
  good &= (o->alpha >= (dbk_real)0 && o->alpha <= (dbk_real)1e6);
  good &= (o->reaction >= (dbk_real)0 && o->reaction <= (dbk_real)1e3);
  good &= (o->brake >= (dbk_real)0 && o->brake <= (dbk_real)1e6 && o->approach >= (dbk_real)0 && o->approach <= (dbk_real)1e3);
  good &= (o->rank >= DBK_RANK_BODY && o->rank <= DBK_RANK_TASK);
  return good;
}

/* a capsule around one obstacle: itself, or along the longest edge of a box through its middle; a half-space has none */
static void cover(const dbk_obstacle *o, dbk_covers *to, int32_t at) {
  int32_t axis = 2;
  to->half[at] = o->half[2];
  to->radius[at] = o->radius;
  if (o->shape == DBK_BOX) {
    for (int32_t e = 0; e < 2; ++e) {
      if (o->half[e] > o->half[axis]) { axis = e; }
    }
    const dbk_real *h = o->half;
    to->half[at] = h[axis];
    to->radius[at] = length(h[(axis + 1) % 3], h[(axis + 2) % 3], (dbk_real)0) + DBK_CULL_FLOOR * (dbk_real)0.01;
  }
  to->ax[at] = o->rotation[axis];
  to->ay[at] = o->rotation[3 + axis];
  to->az[at] = o->rotation[6 + axis];
  to->x[at] = o->position[0];
  to->y[at] = o->position[1];
  to->z[at] = o->position[2];
}

/* what every obstacle is covered by, and what the rows need of it; behind the last one nothing is asked for */
static void prepare_covers(dbk_scene *scene) {
  static const dbk_obstacle nothing = {.shape = DBK_CAPSULE, .flags = DBK_STATIC};
  dbk_covers *to = &scene->covers;
  to->any_half_space = to->any_separation = 0;
  for (int32_t i = 0; i < DBK_MAX_OBSTACLES; ++i) {
    const dbk_obstacle *o = i < scene->n_obstacles ? &scene->obstacle[i] : &nothing;
    cover(o, to, i);
    to->vx[i] = o->velocity[0];
    to->vy[i] = o->velocity[1];
    to->vz[i] = o->velocity[2];
    to->margin[i] = o->margin;
    to->alpha[i] = o->alpha;
    to->error[i] = o->velocity_error;
    to->speed[i] = length(o->velocity[0], o->velocity[1], o->velocity[2]) + o->velocity_error;
    to->parts[i] = o->parts;
    to->known[i] = (o->flags & DBK_KNOWN) != 0;
    to->moving[i] = !(o->flags & DBK_STATIC);
    to->rank[i] = o->rank;
    to->plain[i] = o->shape == DBK_CAPSULE && !(o->brake > (dbk_real)0);
    to->any_half_space |= o->shape == DBK_HALF_SPACE;
    to->any_separation |= o->brake > (dbk_real)0;
  }
}

static int32_t held_good(const dbk_scene *scene) {
  if (!(scene->n_held >= 0 && scene->n_held <= DBK_MAX_HELD && dbk_finite(scene->held_error))) { return 0; }
  return dbk_all_finite(scene->held_x, scene->n_held) & dbk_all_finite(scene->held_y, scene->n_held) &
         dbk_all_finite(scene->held_z, scene->n_held) & dbk_all_finite(scene->held_r, scene->n_held);
}

static int32_t users_good(const dbk_scene *scene) {
  int32_t good = scene->n_user >= 0 && scene->n_user <= DBK_MAX_USER;
  for (int32_t r = 0; good && r < scene->n_user; ++r) {
    good &= dbk_all_finite(scene->user_a[r], DBK_MAX_DOF) & dbk_finite(scene->user_b[r]);
    good &= (scene->user_rank[r] >= DBK_RANK_BODY && scene->user_rank[r] <= DBK_RANK_TASK);
  }
  return good;
}

/* refuses a scene with a number that is not finite: `ready` stays 0 and every step stops */
void dbk_scene_prepare(dbk_scene *scene) {
  int32_t good = scene->n_obstacles >= 0 && scene->n_obstacles <= DBK_MAX_OBSTACLES;
  good = good && held_good(scene) && users_good(scene);
  scene->moving = 0;
  for (int32_t o = 0; good && o < scene->n_obstacles; ++o) {
    good &= obstacle_good(&scene->obstacle[o]);
    if (!(scene->obstacle[o].flags & DBK_STATIC)) { scene->moving = 1; }
  }
  if (good) {
    prepare_covers(scene);
    scene->held_ball = ball_around(scene->held_x, scene->held_y, scene->held_z, scene->held_r, scene->n_held,
                                   (dbk_real)0);
  }
  scene->ready = good;
}

void dbk_init(dbk_ctx *ctx) {
  ctx->n_warm = 0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    ctx->u_prev[k] = (dbk_real)0;
    ctx->u_nom_prev[k] = (dbk_real)0;
    ctx->change[k] = (dbk_real)0;
  }
}
