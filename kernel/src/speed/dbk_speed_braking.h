/* Braking within the speed limits. */
#ifndef DBK_SPEED_BRAKING_H
#define DBK_SPEED_BRAKING_H

#include "dbk_math.h"

/* Moves the braking control to the closest one that keeps the speed limits with their reserve for growth. If none is
 * found within the control bounds, then to one that keeps the allowed speeds, or else to one with the least part of the
 * excess of braking over them; the limits that it exceeds become its speeds. Returns DBK_OVERSPEED if one of these is
 * above the allowed speed, else 0. */
int32_t dbk_brake_within_speed(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                               dbk_real brake[DBK_MAX_DOF]);

#endif
