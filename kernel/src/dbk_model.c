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

/* refuses a scene with a number that is not finite: `ready` stays 0 and every step stops */
void dbk_scene_prepare(dbk_scene *scene) {
  int32_t good = scene->n_obstacles >= 0 && scene->n_obstacles <= DBK_MAX_OBSTACLES;
  good &= scene->n_user >= 0 && scene->n_user <= DBK_MAX_USER;
  good &= scene->n_held >= 0 && scene->n_held <= DBK_MAX_HELD && dbk_finite(scene->held_error);
  scene->moving = 0;
  if (good) {
    for (int32_t o = 0; o < scene->n_obstacles; ++o) {
      good &= obstacle_good(&scene->obstacle[o]);
      if (!(scene->obstacle[o].flags & DBK_STATIC)) { scene->moving = 1; }
    }
    good &= dbk_all_finite(scene->held_x, scene->n_held) & dbk_all_finite(scene->held_y, scene->n_held);
    good &= dbk_all_finite(scene->held_z, scene->n_held) & dbk_all_finite(scene->held_r, scene->n_held);
    for (int32_t r = 0; r < scene->n_user; ++r) {
      good &= dbk_all_finite(scene->user_a[r], DBK_MAX_DOF) & dbk_finite(scene->user_b[r]);
      good &= (scene->user_rank[r] >= DBK_RANK_BODY && scene->user_rank[r] <= DBK_RANK_TASK);
    }
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
