/* Preparation of a model: maximum lever arms of the joints, bounding spheres of the links, shares of the tracking. */
#include "model/dbk_model.h"

/* [1/s] bounds of min a/v, so that its square and its inverse are finite */
#define MIN_BRAKING_RATE ((dbk_real)1e-3)
#define MAX_BRAKING_RATE ((dbk_real)1e6)

/* maximum distance between the origin of frame k and its parent's origin over the range of joint k */
static dbk_real joint_offset_max(const dbk_model *model, int32_t k) {
  const dbk_real fixed = dbk_length(model->joint_offset[k][0], model->joint_offset[k][1], model->joint_offset[k][2]);
  if (model->joint_kind[k] != DBK_PRISMATIC) { return fixed; }
  return fixed + dbk_max(dbk_abs(model->q_lower[k]), dbk_abs(model->q_upper[k]));
}

/* speed of a point per unit speed of joint k: the lever arm of a revolute joint, 1 for a prismatic joint */
static dbk_real lever(const dbk_model *model, int32_t k, dbk_real arm) {
  return model->joint_kind[k] == DBK_PRISMATIC ? (dbk_real)1 : arm;
}

/* The bounding sphere is centred at the middle of the bounding box of the sphere centres. A margin of 0.01 mm covers
 * the rounding errors of later computations with it. */
dbk_bounding_sphere dbk_enclosing_sphere(const dbk_real *x, const dbk_real *y, const dbk_real *z,
                                         const dbk_real *radius, int32_t count, dbk_real shift) {
  dbk_bounding_sphere bound = {(dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0, (dbk_real)0};
  if (count <= 0) { return bound; }
  /* bounding box of the centres */
  dbk_real lo[3] = {DBK_MAX_DISTANCE, DBK_MAX_DISTANCE, DBK_MAX_DISTANCE},
           hi[3] = {-DBK_MAX_DISTANCE, -DBK_MAX_DISTANCE, -DBK_MAX_DISTANCE};
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
  /* radius: the farthest surface point; inner distance: the surface of the nearest sphere */
  bound.inner_distance = DBK_MAX_DISTANCE;
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real distance = dbk_length(x[s] - cx, y[s] - cy, z[s] - cz);
    bound.radius = dbk_max(bound.radius, distance + radius[s] + slack);
    bound.centres_radius = dbk_max(bound.centres_radius, distance + slack);
    bound.inner_distance = dbk_min(bound.inner_distance, distance - radius[s] + slack);
  }
  bound.x = cx - x[0];
  bound.y = cy - y[0];
  bound.z = cz - z[0];
  return bound;
}

/* bounding spheres of all links; finger spheres that open in different directions move relative to each other */
static void prepare_bounding_spheres(dbk_model *model) {
  for (int32_t l = 0; l < model->n_links; ++l) {
    const int32_t first = model->link_first[l], last = model->link_first[l + 1];
    dbk_real shift = (dbk_real)0;
    for (int32_t s = first; s < last; ++s) {
      const dbk_real relative =
          dbk_length(model->slide_x[s] - model->slide_x[first], model->slide_y[s] - model->slide_y[first],
                     model->slide_z[s] - model->slide_z[first]);
      shift = dbk_max(shift, (dbk_real)0.1 * relative); /* the gripper opening is below 0.1 m */
    }
    model->bounding_sphere[l] = dbk_enclosing_sphere(model->x + first, model->y + first, model->z + first,
                                                     model->radius + first, last - first, shift);
  }
}

/* the first sphere that each joint moves, rounded down to a whole SIMD vector */
static void prepare_first_moved(dbk_model *model) {
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    int32_t first = model->n_spheres;
    for (int32_t s = model->n_spheres - 1; s >= 0; --s) { first = model->reach[k][s] <= (dbk_real)0 ? first : s; }
    model->first_moved[k] = first & ~(DBK_LANES - 1);
  }
}

/* maximum lever arm of every joint over the spheres of every link */
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

/* the QP reads all DBK_MAX_DOF rows and columns of the scale */
static void clear_unused_scale(dbk_model *model) {
  for (int32_t i = 0; i < DBK_MAX_DOF; ++i) {
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
      if (i >= model->n || k >= model->n) { model->scale[i][k] = (dbk_real)0; }
    }
  }
}

/* The tracking margins relative to their maximum. The shares are exactly 1 where all margins are equal, so that their
 * rows are those of one margin for all joints, to the last bit. */
static void prepare_tracking(dbk_model *model) {
  model->tracking_max = (dbk_real)0;
  for (int32_t k = 0; k < model->n; ++k) { model->tracking_max = dbk_max(model->tracking_max, model->tracking[k]); }
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    const int32_t used = k < model->n && model->tracking_max > (dbk_real)0;
    model->tracking_share[k] = used ? model->tracking[k] / model->tracking_max : (dbk_real)0;
  }
}

/* With the braking time 1/g of the slowest joint, g = min a/v: 2 g, and 1/(2 g dt). */
static void prepare_braking(dbk_model *model) {
  dbk_real rate = MAX_BRAKING_RATE;
  for (int32_t k = 0; k < model->n; ++k) {
    if (model->a_max[k] < rate * model->v_max[k]) { rate = model->a_max[k] / model->v_max[k]; }
  }
  rate = dbk_max(rate, MIN_BRAKING_RATE);
  model->braking_gain = (dbk_real)2 * rate;
  model->arc_share = (dbk_real)0.5 / (rate * model->period);
}

/* Computes reach[k][s], an upper bound over all postures of the speed of sphere s per unit speed of joint k. For a
 * revolute joint it is the sum of the lengths of all offsets between the joint and the sphere. */
void dbk_prepare(dbk_model *model) {
  clear_unused_scale(model);
  prepare_tracking(model);
  prepare_braking(model);
  /* the spheres of the links: accumulate the offsets from the sphere's frame toward the base */
  for (int32_t l = 0; l < model->n_links; ++l) {
    const int32_t frame = model->link_frame[l];
    for (int32_t s = model->link_first[l]; s < model->link_first[l + 1]; ++s) {
      const dbk_real slide = (dbk_real)0.1 * dbk_length(model->slide_x[s], model->slide_y[s], model->slide_z[s]);
      model->sphere_frame[s] = frame;
      dbk_real arm = dbk_length(model->x[s], model->y[s], model->z[s]) + slide; /* the opening is below 0.1 m */
      for (int32_t k = DBK_MAX_DOF - 1; k >= 0; --k) {
        model->reach[k][s] = (dbk_real)0;
        if (k < frame) {
          model->reach[k][s] = lever(model, k, arm);
          arm += joint_offset_max(model, k);
        }
      }
    }
  }
  for (int32_t s = model->n_spheres; s < model->n_spheres + DBK_MAX_HELD; ++s) { model->sphere_frame[s] = model->n; }
  /* the held object: it extends at most 0.5 m from the tool */
  dbk_real arm = (dbk_real)0.5 + dbk_length(model->tool_offset[0], model->tool_offset[1], model->tool_offset[2]);
  for (int32_t k = DBK_MAX_DOF - 1; k >= 0; --k) {
    for (int32_t s = model->n_spheres; s < model->n_spheres + DBK_MAX_HELD; ++s) {
      model->reach[k][s] = k < model->n ? lever(model, k, arm) : (dbk_real)0;
    }
    if (k < model->n) { arm += joint_offset_max(model, k); }
  }
  prepare_first_moved(model);
  prepare_link_reach(model);
  prepare_bounding_spheres(model);
}
