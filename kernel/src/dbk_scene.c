/* What is computed once for a scene: its sanity, and a capsule around every obstacle. */
#include "dbk_pair.h"

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
    to->radius[at] = dbk_length(h[(axis + 1) % 3], h[(axis + 2) % 3], (dbk_real)0) + DBK_CULL_FLOOR * (dbk_real)0.01;
  }
  to->ax[at] = o->rotation[axis];
  to->ay[at] = o->rotation[3 + axis];
  to->az[at] = o->rotation[6 + axis];
  to->x[at] = o->position[0];
  to->y[at] = o->position[1];
  to->z[at] = o->position[2];
}

/* what every obstacle is covered by, and what the rows need of it; behind the last one, up to a full vector, nothing is
 * asked for */
static void prepare_covers(dbk_scene *scene) {
  static const dbk_obstacle nothing = {.shape = DBK_CAPSULE, .flags = DBK_STATIC};
  dbk_covers *to = &scene->covers;
  to->any_half_space = to->any_separation = to->any_long = 0;
  for (int32_t i = 0; i < DBK_PADDED(scene->n_obstacles); ++i) {
    const dbk_obstacle *o = i < scene->n_obstacles ? &scene->obstacle[i] : &nothing;
    cover(o, to, i);
    to->vx[i] = o->velocity[0];
    to->vy[i] = o->velocity[1];
    to->vz[i] = o->velocity[2];
    to->margin[i] = o->margin;
    to->alpha[i] = o->alpha;
    to->error[i] = o->velocity_error;
    to->speed[i] = dbk_length(o->velocity[0], o->velocity[1], o->velocity[2]) + o->velocity_error;
    to->parts[i] = o->parts;
    to->known[i] = (o->flags & DBK_KNOWN) != 0;
    to->moving[i] = !(o->flags & DBK_STATIC);
    to->rank[i] = o->rank;
    to->plain[i] = o->shape == DBK_CAPSULE && !(o->brake > (dbk_real)0);
    to->ball[i] = !(to->half[i] > (dbk_real)0) && !(to->speed[i] > (dbk_real)0);
    to->any_half_space |= o->shape == DBK_HALF_SPACE;
    to->any_separation |= o->brake > (dbk_real)0;
    to->any_long |= to->half[i] != (dbk_real)0;
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
    scene->held_ball = dbk_ball_around(scene->held_x, scene->held_y, scene->held_z, scene->held_r, scene->n_held,
                                       (dbk_real)0);
  }
  scene->ready = good;
}
