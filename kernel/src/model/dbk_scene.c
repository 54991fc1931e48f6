/* Preparation of a scene: validation, and an enclosing capsule of every obstacle. */
#include "model/dbk_model.h"

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

/* 1 if all numbers are within -limit..limit; the comparisons reject NaN */
static int32_t all_within(const dbk_real *x, int32_t count, dbk_real limit) {
  int32_t valid = 1;
  for (int32_t i = 0; i < count; ++i) { valid &= (x[i] >= -limit && x[i] <= limit); }
  return valid;
}

/* 1 if all numbers are within 0..limit; a size, margin or error below zero would make an obstacle smaller */
static int32_t all_lengths(const dbk_real *x, int32_t count, dbk_real limit) {
  int32_t valid = 1;
  for (int32_t i = 0; i < count; ++i) { valid &= (x[i] >= (dbk_real)0 && x[i] <= limit); }
  return valid;
}

/* 1 if the columns of a matrix are unit vectors and perpendicular to each other */
static int32_t is_rotation(const dbk_real *r) {
  int32_t valid = all_within(r, 9, (dbk_real)2);
  for (int32_t i = 0; valid && i < 3; ++i) {
    for (int32_t j = i; j < 3; ++j) {
      const dbk_real product = r[i] * r[j] + r[3 + i] * r[3 + j] + r[6 + i] * r[6 + j];
      valid &= (dbk_abs(product - (i == j ? (dbk_real)1 : (dbk_real)0)) <= DBK_ROTATION_TOL);
    }
  }
  return valid;
}

static int32_t obstacle_valid(const dbk_obstacle *o) {
  int32_t valid = all_within(o->position, 3, DBK_MAX_POSITION) & is_rotation(o->rotation);
  valid &= all_lengths(o->half, 3, DBK_MAX_SIZE) & all_lengths(&o->radius, 1, DBK_MAX_SIZE);
  valid &= all_lengths(&o->margin, 1, DBK_MAX_SIZE) & all_lengths(&o->velocity_error, 1, DBK_MAX_SIZE);
  valid &= all_within(o->velocity, 3, DBK_MAX_SPEED);
  valid &= (o->shape >= DBK_CAPSULE && o->shape <= DBK_HALF_SPACE);
  valid &= (o->alpha >= (dbk_real)0 && o->alpha <= (dbk_real)1e6);
  valid &= (o->reaction >= (dbk_real)0 && o->reaction <= (dbk_real)1e3);
  valid &= (o->brake >= (dbk_real)0 && o->brake <= (dbk_real)1e6 && o->approach >= (dbk_real)0 &&
            o->approach <= (dbk_real)1e3);
  valid &= (o->near_speed >= (dbk_real)0 && o->near_speed <= DBK_MAX_SPEED);
  valid &= (o->near_brake >= (dbk_real)0 && o->near_brake <= (dbk_real)1e6);
  valid &= all_lengths(&o->near_distance, 1, DBK_MAX_SIZE) & all_lengths(&o->near_approach, 1, DBK_MAX_SPEED);
  valid &= (o->rank >= DBK_RANK_BODY && o->rank <= DBK_RANK_TASK);
  return valid;
}

/* The enclosing capsule of a capsule is the capsule itself. The enclosing capsule of a box has its axis along the
 * longest edge through the centre, and its radius is half the diagonal of the cross-section. A half-space has no
 * capsule. */
static void set_capsule(const dbk_obstacle *o, dbk_obstacle_capsules *to, int32_t at) {
  int32_t axis = 2;
  to->half[at] = o->half[2];
  to->radius[at] = o->radius;
  if (o->shape == DBK_BOX) {
    for (int32_t e = 0; e < 2; ++e) {
      if (o->half[e] > o->half[axis]) { axis = e; }
    }
    const dbk_real *h = o->half;
    to->half[at] = h[axis];
    to->radius[at] = dbk_length(h[(axis + 1) % 3], h[(axis + 2) % 3], (dbk_real)0) + DBK_CULL_FLOOR * (dbk_real)0.01;
  }
  to->ax[at] = o->rotation[axis];
  to->ay[at] = o->rotation[3 + axis];
  to->az[at] = o->rotation[6 + axis];
  to->x[at] = o->position[0];
  to->y[at] = o->position[1];
  to->z[at] = o->position[2];
}

static dbk_real max_speed(const dbk_obstacle *o) {
  return dbk_length(o->velocity[0], o->velocity[1], o->velocity[2]) + o->velocity_error;
}

/* an obstacle with a velocity or a velocity error moves, with or without the flag */
static int32_t obstacle_moves(const dbk_obstacle *o) {
  return !(o->flags & DBK_STATIC) || max_speed(o) > (dbk_real)0;
}

/* capsules and row parameters of all obstacles; the entries after the last obstacle have an empty link mask */
static void prepare_capsules(dbk_scene *scene) {
  static const dbk_obstacle empty = {.shape = DBK_CAPSULE, .flags = DBK_STATIC};
  dbk_obstacle_capsules *to = &scene->capsules;
  to->any_half_space = to->any_separation = to->any_elongated = to->any_near = 0;
  for (int32_t i = 0; i < DBK_PADDED(scene->n_obstacles); ++i) {
    const dbk_obstacle *o = i < scene->n_obstacles ? &scene->obstacle[i] : &empty;
    set_capsule(o, to, i);
    to->vx[i] = o->velocity[0];
    to->vy[i] = o->velocity[1];
    to->vz[i] = o->velocity[2];
    to->margin[i] = o->margin;
    to->alpha[i] = o->alpha;
    to->velocity_error[i] = o->velocity_error;
    to->max_speed[i] = max_speed(o);
    to->link_mask[i] = o->link_mask;
    to->known[i] = (o->flags & DBK_KNOWN) != 0;
    to->moving[i] = obstacle_moves(o);
    to->rank[i] = o->rank;
    to->plain[i] = o->shape == DBK_CAPSULE && !(o->brake > (dbk_real)0);
    to->static_sphere[i] = !(to->half[i] > (dbk_real)0) && !(to->max_speed[i] > (dbk_real)0);
    to->any_half_space |= o->shape == DBK_HALF_SPACE;
    to->any_separation |= o->brake > (dbk_real)0;
    to->any_near |= o->near_speed > (dbk_real)0;
    to->any_elongated |= to->half[i] != (dbk_real)0;
  }
}

static int32_t held_valid(const dbk_scene *scene) {
  if (!(scene->n_held >= 0 && scene->n_held <= DBK_MAX_HELD)) { return 0; }
  return all_within(scene->held_x, scene->n_held, DBK_MAX_DISTANCE) &
         all_within(scene->held_y, scene->n_held, DBK_MAX_DISTANCE) &
         all_within(scene->held_z, scene->n_held, DBK_MAX_DISTANCE) &
         all_lengths(scene->held_r, scene->n_held, DBK_MAX_DISTANCE) &
         all_lengths(&scene->held_error, 1, DBK_MAX_DISTANCE);
}

static int32_t user_rows_valid(const dbk_scene *scene) {
  int32_t valid = scene->n_user >= 0 && scene->n_user <= DBK_MAX_USER;
  for (int32_t r = 0; valid && r < scene->n_user; ++r) {
    valid &= dbk_all_finite(scene->user_a[r], DBK_MAX_DOF) & dbk_finite(scene->user_b[r]);
    valid &= (scene->user_rank[r] >= DBK_RANK_BODY && scene->user_rank[r] <= DBK_RANK_TASK);
  }
  return valid;
}

int32_t dbk_first_invalid_obstacle(const dbk_scene *scene) {
  int32_t o = 0;
  while (o < scene->n_obstacles && obstacle_valid(&scene->obstacle[o])) { ++o; }
  return o;
}

/* If the scene contains an invalid value, `ready` stays 0 and every step stops the robot. */
void dbk_scene_prepare(dbk_scene *scene) {
  int32_t valid = scene->n_obstacles >= 0 && scene->n_obstacles <= DBK_MAX_OBSTACLES;
  valid = valid && held_valid(scene) && user_rows_valid(scene);
  scene->moving = 0;
  if (valid) {
    const int32_t invalid = dbk_first_invalid_obstacle(scene);
    for (int32_t o = 0; o < scene->n_obstacles && o <= invalid; ++o) {
      scene->moving |= obstacle_moves(&scene->obstacle[o]);
    }
    valid = invalid == scene->n_obstacles;
  }
  if (valid) {
    prepare_capsules(scene);
    scene->held_bounding_sphere =
        dbk_enclosing_sphere(scene->held_x, scene->held_y, scene->held_z, scene->held_r, scene->n_held, (dbk_real)0);
  }
  scene->ready = valid;
}
