/* Access to the links of a model, and bounding spheres. Link index n_links denotes the held object. */
#ifndef DBK_MODEL_H
#define DBK_MODEL_H

#include "dbk_math.h"

static inline int32_t dbk_link_first_sphere(const dbk_model *model, int32_t link) {
  return link == model->n_links ? model->n_spheres : model->link_first[link];
}

/* index after the last sphere of a link */
static inline int32_t dbk_link_end_sphere(const dbk_model *model, const dbk_scene *scene, int32_t link) {
  return link == model->n_links ? model->n_spheres + scene->n_held : model->link_first[link + 1];
}

static inline int32_t dbk_link_frame(const dbk_model *model, int32_t link) {
  return link == model->n_links ? model->n : model->link_frame[link];
}

/* a link is tested for collisions only if a joint moves it (frame 0 is fixed) and it has spheres */
static inline int32_t dbk_link_can_collide(const dbk_model *model, const dbk_scene *scene, int32_t link) {
  return dbk_link_frame(model, link) > 0 &&
         dbk_link_first_sphere(model, link) < dbk_link_end_sphere(model, scene, link);
}

/* bounding sphere of `count` spheres whose centres move by at most `shift` [m] relative to the first one */
dbk_bounding_sphere dbk_enclosing_sphere(const dbk_real *x, const dbk_real *y, const dbk_real *z,
                                         const dbk_real *radius, int32_t count, dbk_real shift);

#endif
