/* Properties of single obstacles. */
#ifndef DBK_SCENE_H
#define DBK_SCENE_H

#include "dbk_math.h"

/* 1: the obstacle is a capsule without speed and separation monitoring, and the link has no permit to touch it. Only
 * such obstacles are processed in batches */
static inline int32_t dbk_uses_plain_capsule(const dbk_scene *scene, int32_t link, int32_t obstacle) {
  return scene->capsules.plain[obstacle] & (scene->permit[link][obstacle] < (dbk_real)0);
}

/* index of the first obstacle with an invalid value; n_obstacles if there is none */
int32_t dbk_first_invalid_obstacle(const dbk_scene *scene);

/* Speed and separation monitoring (ISO/TS 15066): the maximum speed v toward a person at distance d at which the robot
 * still stops in time. v solves d = v_h (T_r + T_s) + v T_r + v^2 / (2 a) with the stopping time T_s = v / a, the
 * reaction time T_r, the deceleration a and the speed v_h of the person. The result is 0 if even a robot at rest is too
 * close. */
static inline dbk_real dbk_separation_speed(const dbk_obstacle *o, dbk_real d, dbk_real person_speed) {
  const dbk_real delay = o->reaction + person_speed / o->brake, spare = d - person_speed * o->reaction;
  if (!(spare > (dbk_real)0)) { return (dbk_real)0; }
  return o->brake * (dbk_sqrt(delay * delay + (dbk_real)2 * spare / o->brake) - delay);
}

#endif
