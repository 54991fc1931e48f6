/* Broad phase: selects the obstacles that are relevant for each link by its bounding sphere. */
#ifndef DBK_BROADPHASE_H
#define DBK_BROADPHASE_H

#include "dbk_math.h"

/* obstacles at the current time, with the parameters that their rows use */
typedef struct {
  dbk_real x[DBK_OBSTACLE_CAPACITY], y[DBK_OBSTACLE_CAPACITY], z[DBK_OBSTACLE_CAPACITY];
  dbk_real margin[DBK_OBSTACLE_CAPACITY], alpha[DBK_OBSTACLE_CAPACITY];
  uint32_t link_mask[DBK_OBSTACLE_CAPACITY]; /* as in dbk_obstacle; 0 for an ignored obstacle */
  int32_t lanes;                             /* number of obstacles, rounded up to whole SIMD vectors */
  dbk_real age, extra;                       /* age of the scene [s], extra clearance [m] */
  int32_t known_only;
} dbk_predicted_obstacles;

/* relevant obstacles of every link, in ascending order */
typedef struct {
  int32_t count[DBK_ALL_LINKS];
  int16_t index[DBK_ALL_LINKS][DBK_MAX_OBSTACLES];
} dbk_candidates;

/* the spheres of one link and its relevant obstacles */
typedef struct {
  int32_t link, first, count, frame; /* spheres first..first+count-1 */
  dbk_real held_error;
  int32_t n_obstacles;
  const int16_t *obstacle;
} dbk_link_candidates;

/* predicts the obstacles over the age of the scene; ignores unknown obstacles if `known_only` */
void dbk_predict_obstacles(const dbk_model *model, const dbk_scene *scene, dbk_real age, dbk_real extra,
                           int32_t known_only, dbk_predicted_obstacles *out);

void dbk_broadphase(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                    const dbk_predicted_obstacles *predicted, dbk_candidates *out);

#endif
