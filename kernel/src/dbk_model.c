/* What is computed once for a model: longest lever arms, and balls around links. */
#include "dbk_pair.h"

/* how far joint k can carry what lies beyond it from its own parent */
static dbk_real span(const dbk_model *model, int32_t k) {
  const dbk_real fixed = dbk_length(model->joint_offset[k][0], model->joint_offset[k][1], model->joint_offset[k][2]);
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
dbk_ball dbk_ball_around(const dbk_real *x, const dbk_real *y, const dbk_real *z, const dbk_real *radius, int32_t count,
                         dbk_real shift) {
  dbk_ball ball = {(dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0};
  if (count <= 0) { return ball; }
  dbk_real lo[3] = {DBK_BEYOND, DBK_BEYOND, DBK_BEYOND}, hi[3] = {-DBK_BEYOND, -DBK_BEYOND, -DBK_BEYOND};
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
  ball.inner = DBK_BEYOND;
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real off = dbk_length(x[s] - cx, y[s] - cy, z[s] - cz);
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
      const dbk_real apart = dbk_length(model->slide_x[s] - model->slide_x[first], model->slide_y[s] - model->slide_y[first],
                                    model->slide_z[s] - model->slide_z[first]);
      shift = dbk_max(shift, (dbk_real)0.1 * apart); /* an opening is below 0.1 m */
    }
    model->ball[l] = dbk_ball_around(model->x + first, model->y + first, model->z + first, model->radius + first,
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

/* the QP reads the scale to its full width */
static void clear_scale(dbk_model *model) {
  for (int32_t i = 0; i < DBK_MAX_DOF; ++i) {
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
      if (i >= model->n || k >= model->n) { model->scale[i][k] = (dbk_real)0; }
    }
  }
}

void dbk_prepare(dbk_model *model) {
  clear_scale(model);
  for (int32_t l = 0; l < model->n_links; ++l) {
    const int32_t frame = model->link_frame[l];
    for (int32_t s = model->link_first[l]; s < model->link_first[l + 1]; ++s) {
      const dbk_real slide = (dbk_real)0.1 * dbk_length(model->slide_x[s], model->slide_y[s], model->slide_z[s]);
      model->sphere_frame[s] = frame;
      dbk_real arm = dbk_length(model->x[s], model->y[s], model->z[s]) + slide; /* an opening is below 0.1 m */
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
  dbk_real arm = (dbk_real)0.5 + dbk_length(model->tool_offset[0], model->tool_offset[1], model->tool_offset[2]);
  for (int32_t k = DBK_MAX_DOF - 1; k >= 0; --k) {
    for (int32_t s = model->n_spheres; s < model->n_spheres + DBK_MAX_HELD; ++s) {
      model->reach[k][s] = k < model->n ? lever(model, k, arm) : (dbk_real)0;
    }
    if (k < model->n) { arm += span(model, k); }
  }
  prepare_link_reach(model);
  prepare_balls(model);
}

void dbk_init(dbk_ctx *ctx) {
  ctx->n_warm = 0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    ctx->u_prev[k] = (dbk_real)0;
    ctx->u_nom_prev[k] = (dbk_real)0;
    ctx->change[k] = (dbk_real)0;
  }
}
