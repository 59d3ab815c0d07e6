// Where rays are inside a solid: origin + s direction for s in [enter, exit], none if enter >= exit.
// Included once with FLOATS = float and once with a vector of LANES, for shadow rays and for a row of pixels.
//   planes  n.(o + s d) <= c cuts s at (c - n.o) / (n.d): the last entry before the first exit
//   sphere  around the ray's nearest point q = o + s0 d: s0 -+ sqrt((1 - |q|^2) / |d|^2), free of cancellation

static void JOIN(clip_, FLOATS)(FLOATS along, float margin, FLOATS* enter, FLOATS* exit)
{
  const FLOATS slope = select(along, (FLOATS)(TINY), fabs(along) < TINY);
  const FLOATS s = margin / slope;
  *enter = max(*enter, select((FLOATS)(-INFINITY), s, slope < 0));
  *exit = min(*exit, select((FLOATS)(INFINITY), s, slope > 0));
}

static void JOIN(interval_, FLOATS)(
    global const solid_t* solid, float3 origin, FLOATS dx, FLOATS dy, FLOATS dz, FLOATS* enter, FLOATS* exit)
{
  const float3 scale = 1 / load3(solid->half_size);
  const float3 o = to_local(solid, origin - load3(solid->centre)) * scale;
  const FLOATS x = (solid->cos_yaw * dx - solid->sin_yaw * dz) * scale.x;
  const FLOATS y = dy * scale.y;
  const FLOATS z = (solid->sin_yaw * dx + solid->cos_yaw * dz) * scale.z;
  FLOATS first = -INFINITY, last = INFINITY;
  if (solid->shape != SHAPE_ELLIPSOID) {
    JOIN(clip_, FLOATS)(y, 1 - o.y, &first, &last);
    JOIN(clip_, FLOATS)(-y, 1 + o.y, &first, &last);
  }
  if (solid->shape == SHAPE_BOX) {
    const float side = 0.5f * solid->taper[0], front = 0.5f * solid->taper[1], back = 0.5f * solid->taper[2];
    JOIN(clip_, FLOATS)(x - side * y, 1 - side - o.x + side * o.y, &first, &last);
    JOIN(clip_, FLOATS)(-x - side * y, 1 - side + o.x + side * o.y, &first, &last);
    JOIN(clip_, FLOATS)(z - front * y, 1 - front - o.z + front * o.y, &first, &last);
    JOIN(clip_, FLOATS)(-z - back * y, 1 - back + o.z + back * o.y, &first, &last);
  } else {
    const float upright = solid->shape == SHAPE_ELLIPSOID ? 1.0f : 0.0f;
    const FLOATS square = max(x * x + z * z + upright * y * y, (FLOATS)(TINY));
    const FLOATS nearest = -(o.x * x + o.z * z + upright * o.y * y) / square;
    const FLOATS qx = o.x + nearest * x, qy = upright * (o.y + nearest * y), qz = o.z + nearest * z;
    const FLOATS inside = 1 - qx * qx - qy * qy - qz * qz;
    const FLOATS half_chord = sqrt(max(inside, (FLOATS)(0)) / square);
    first = max(first, select((FLOATS)(INFINITY), nearest - half_chord, inside > 0));
    last = min(last, nearest + half_chord);
  }
  *enter = first;
  *exit = last;
}
