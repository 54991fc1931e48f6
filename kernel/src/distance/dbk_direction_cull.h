/* Second broad phase of a link and its candidates, by the direction of the motion. */
#ifndef DBK_DIRECTION_CULL_H
#define DBK_DIRECTION_CULL_H

#include "distance/dbk_broadphase.h"

/* removes the obstacles from `index`, the candidates of a link, that no control within the trust region can violate a
 * row of, that no control within the control bounds can reach, and that are not the nearest; returns the number of the
 * remaining obstacles */
int32_t dbk_cull_by_direction(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                              const dbk_predicted_obstacles *predicted, const dbk_link_candidates *link,
                              int16_t *index);

#endif
