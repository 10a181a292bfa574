from __future__ import annotations

import numpy as np

from ceilvo.types import Landmarks


def visible(cal, margin=0.08):
    w,h=cal.camera.width_px,cal.camera.height_px
    x0,x1,y0,y1=margin*w,(1-margin)*w,margin*h,(1-margin)*h
    t=np.linspace(0,1,9)[:-1]
    uv=np.concatenate([np.column_stack([x0+(x1-x0)*t,0*t+y0]),np.column_stack([0*t+x1,y0+(y1-y0)*t]),np.column_stack([x1-(x1-x0)*t,0*t+y1]),np.column_stack([0*t+x0,y1-(y1-y0)*t])])
    lv=cal.level_view.from_raw(uv)
    p=np.column_stack([lv,np.ones(len(lv))])@np.asarray(cal.ceiling_from_level).T
    p=p[:,:2]/p[:,2:]
    a=0.5*np.sum(p[:,0]*np.roll(p[:,1],-1)-np.roll(p[:,0],-1)*p[:,1])
    return p if a>0 else p[::-1]

def landmarks_near(f, xy, reach):
    lm=f.landmarks()
    lab=np.flatnonzero(np.all((lm.xy_map_m>=xy.min(0)-reach)&(lm.xy_map_m<=xy.max(0)+reach),axis=1))
    return lab, Landmarks(lm.ids[lab],lm.xy_map_m[lab],lm.cov_m2[lab],lm.crossing_type[lab],lm.sightings[lab],lm.expected[lab])

COUNT={}
def visibility(lm):
    return np.array([(COUNT.get(int(i),(1,0))[0]+1)/(COUNT.get(int(i),(1,1))[1]+2) for i in lm.ids])

def count(f,poly,view):
    from ceilvo.se2 import rotation
    pose=f.estimate()[0]
    _,lm=landmarks_near(f,pose[None,:2],2.5)
    at=view.xy_base_m
    back=(lm.xy_map_m-pose[:2])@rotation(float(pose[2]))
    d=np.roll(poly,-1,0)-poly
    ins=np.all(d[None,:,0]*(back[:,None,1]-poly[None,:,1])-d[None,:,1]*(back[:,None,0]-poly[None,:,0])>=0,axis=1)
    if not len(at): return
    dd=np.hypot(back[:,None,0]-at[None,:,0],back[:,None,1]-at[None,:,1]); dd[lm.crossing_type[:,None]!=view.crossing_type[None]]=9
    hit=dd.min(1)<0.1
    for i,h,v in zip(lm.ids,hit,ins):
        if h or v:
            s_,e_=COUNT.get(int(i),(0,0)); COUNT[int(i)]=(s_+int(h),e_+1)

def jump(f,pose,cov):
    if hasattr(f,"_tracker"): f._tracker.jump(pose,cov)
    elif hasattr(f,"jump"): f.jump(pose,cov)
    else: f.reset(pose,cov,f.landmarks())
