/* What the row builders share: one pair of a moving sphere and another thing, and the batch that pairs are weighed in. */
#ifndef DBK_PAIR_H
#define DBK_PAIR_H

#include "dbk_math.h"

#define DBK_BATCH (DBK_SPHERE_ROOM > DBK_OBSTACLE_ROOM ? DBK_SPHERE_ROOM : DBK_OBSTACLE_ROOM)
#define DBK_TINY ((dbk_real)1e-6)  /* [m] nearer than this the direction is rounding noise */
#define DBK_ROUNDED ((dbk_real)1e-5) /* [m/s] more than the rounding of a row's right side */
#define DBK_BEYOND ((dbk_real)10)  /* [m] farther than any robot here reaches */
enum { DBK_SEVERAL = -1 };         /* in place of a sphere: the batch is about several */

/* pairs that are weighed together, one array per number: h, normal, right side, and the room that the worst control of the
 * trust box leaves. One side of the pairs is the same for all: the moving sphere, or (DBK_SEVERAL) the other thing; `index` is
 * what varies. Both are named as in dbk_active. */
typedef struct {
  int32_t count, kind, sphere, other;
  int32_t from, upto; /* joints that move the pairs */
  dbk_real h[DBK_BATCH], nx[DBK_BATCH], ny[DBK_BATCH], nz[DBK_BATCH], rhs[DBK_BATCH], room[DBK_BATCH];
  int32_t index[DBK_BATCH], keep[DBK_BATCH], yielding[DBK_BATCH];
} dbk_batch;

/* the moving sphere: radius, velocity and acceleration at the middle of the box, how much the box can change the former */
typedef struct {
  dbk_real r, vx, vy, vz, ax, ay, az, spread;
} dbk_mover;

static inline dbk_mover dbk_mover_of(const dbk_ctx *ctx, int32_t s) {
  const dbk_motion *m = &ctx->motion;
  const dbk_mover it = {ctx->cloud.r[s], m->vx[s], m->vy[s], m->vz[s], m->ax[s], m->ay[s], m->az[s], m->spread[s]};
  return it;
}

/* the other thing */
typedef struct {
  dbk_real margin, alpha, cap, error, half_period, vx, vy, vz;
} dbk_terms;

typedef struct {
  dbk_real h, rhs, room;
} dbk_weight;

/* distance and outward normal of a point, at (x, y, z) from it */
static inline dbk_real dbk_off_point(dbk_real x, dbk_real y, dbk_real z, dbk_real *nx, dbk_real *ny, dbk_real *nz) {
  const dbk_real far = dbk_sqrt(x * x + y * y + z * z);
  const dbk_real inverse = (dbk_real)1 / (far > DBK_TINY ? far : DBK_TINY);
  *nx = x * inverse;
  *ny = y * inverse;
  *nz = far > DBK_TINY ? z * inverse : (dbk_real)1; /* on the axis: any way out will do */
  return far;
}

/* distance and outward normal of a segment of half length `half` along (ax, ay, az), at (x, y, z) from its middle */
static inline dbk_real dbk_off_segment(dbk_real x, dbk_real y, dbk_real z, dbk_real ax, dbk_real ay, dbk_real az,
                                       dbk_real half, dbk_real *nx, dbk_real *ny, dbk_real *nz) {
  const dbk_real along = x * ax + y * ay + z * az;
  const dbk_real low = along < half ? along : half;
  const dbk_real t = low > -half ? low : -half;
  return dbk_off_point(x - t * ax, y - t * ay, z - t * az, nx, ny, nz);
}

/* h, right side, and the room that the worst control of the box leaves, of a sphere at distance d along normal n; is the
 * other thing `at_rest`, its velocity and the error of that are not looked at */
static inline dbk_weight dbk_weigh(const dbk_mover *m, const dbk_terms *t, int32_t at_rest, dbk_real d, dbk_real nx,
                                   dbk_real ny, dbk_real nz) {
  const dbk_real h = d - m->r - t->margin;
  const dbk_real wanted = -t->alpha * h;
  const dbk_real barrier = wanted < t->cap ? wanted : t->cap;
  const dbk_real bend = -t->half_period * (nx * m->ax + ny * m->ay + nz * m->az);
  const dbk_real followed = at_rest ? barrier : barrier + (nx * t->vx + ny * t->vy + nz * t->vz) + t->error;
  const dbk_real rhs = followed + (bend > (dbk_real)0 ? bend : (dbk_real)0);
  const dbk_real rate = nx * m->vx + ny * m->vy + nz * m->vz;
  const dbk_weight w = {h, rhs, rate - m->spread - rhs};
  return w;
}

/* may a control of the box violate the row, or is the pair too near to be left out? NaN is kept, and fails the check */
static inline int32_t dbk_binds(const dbk_weight *w, int32_t permitted) {
  const int32_t violable = !(w->room >= (dbk_real)0), near = !(w->h >= DBK_CULL_FLOOR);
  return violable | (near & !permitted);
}

static inline int32_t dbk_first_sphere(const dbk_model *model, int32_t link) {
  return link == model->n_links ? model->n_spheres : model->link_first[link];
}

/* one behind the last sphere of a link; link n_links is what is held */
static inline int32_t dbk_last_sphere(const dbk_model *model, const dbk_scene *scene, int32_t link) {
  return link == model->n_links ? model->n_spheres + scene->n_held : model->link_first[link + 1];
}

static inline int32_t dbk_link_frame(const dbk_model *model, int32_t link) {
  return link == model->n_links ? model->n : model->link_frame[link];
}

/* frame 0 is bolted down, and a link without spheres meets nothing */
static inline int32_t dbk_takes_part(const dbk_model *model, const dbk_scene *scene, int32_t link) {
  return dbk_link_frame(model, link) > 0 && dbk_first_sphere(model, link) < dbk_last_sphere(model, scene, link);
}

/* obstacles where they are at this moment, and what the rows take off their distance */
typedef struct {
  dbk_real x[DBK_OBSTACLE_ROOM], y[DBK_OBSTACLE_ROOM], z[DBK_OBSTACLE_ROOM];
  dbk_real margin[DBK_OBSTACLE_ROOM], alpha[DBK_OBSTACLE_ROOM];
  uint32_t parts[DBK_OBSTACLE_ROOM]; /* links that are kept away, as in dbk_obstacle; none where it is left out */
  int32_t lanes;                     /* obstacles, up to a full vector */
  dbk_real age, extra;
  int32_t known_only;
} dbk_surround;

/* the obstacles that matter for every link, in the order of the table */
typedef struct {
  int32_t count[DBK_ALL_LINKS];
  int16_t index[DBK_ALL_LINKS][DBK_MAX_OBSTACLES];
} dbk_nearby;

/* spheres of one link and the obstacles near it */
typedef struct {
  int32_t link, first, count, frame; /* of the spheres */
  dbk_real held_error;
  int32_t n_near;
  const int16_t *near;
} dbk_link_scene;

/* dbk_model.c */
dbk_ball dbk_ball_around(const dbk_real *x, const dbk_real *y, const dbk_real *z, const dbk_real *radius, int32_t count,
                         dbk_real shift);

/* dbk_near.c */
void dbk_surroundings(const dbk_model *model, const dbk_scene *scene, dbk_real age, dbk_real extra, int32_t known_only,
                      dbk_surround *out);
void dbk_find_near(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_surround *around,
                   dbk_nearby *out);
dbk_real dbk_separation_speed(const dbk_obstacle *o, dbk_real d, dbk_real person);

/* dbk_together.c */
void dbk_meet_together(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around,
                       const dbk_link_scene *near);

/* dbk_meet.c, dbk_self.c */
void dbk_meet_obstacles(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around);
void dbk_meet_self(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra);

/* dbk_columns.c: rows->a; `square` and `total` are the sums of squares and of sizes over the joints */
void dbk_fill_columns(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *rows, dbk_real *square, dbk_real *total);

/* dbk_rows.c */
void dbk_keep_rows(const dbk_scene *scene, dbk_ctx *ctx, const dbk_batch *w);
void dbk_remember(dbk_ctx *ctx, int32_t first, int32_t count, int32_t other);

/* is the obstacle its own capsule, and nothing else than the barrier asked for? */
static inline int32_t dbk_sociable(const dbk_scene *scene, int32_t link, int32_t obstacle) {
  return scene->covers.plain[obstacle] & (scene->permit[link][obstacle] < (dbk_real)0);
}

/* the smallest h of a link and an obstacle goes into h_min; what one period could bring to h = 0 is looked at again */
static inline void dbk_judge(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_link_scene *near,
                             int32_t index, dbk_real least) {
  const dbk_real speed = scene->covers.speed[index] + ctx->motion.haste[near->link];
  ctx->h_min = dbk_min(ctx->h_min, least + model->sampling);
  if (!(least >= model->period * speed + DBK_CULL_FLOOR)) { dbk_remember(ctx, near->first, near->count, index); }
}

#endif
